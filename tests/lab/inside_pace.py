"""Inside a machine: how long an iteration takes beside what the same links take one way. A figure, not a test."""

import json
import select
import statistics
import time
from pathlib import Path

from conftest import Processes
from inside_consensus import NAMES, SHARE, Swarm

from lab.radio.remote import Radio
from lab.shapes import LINE
from services.mesh.links import rfcomm
from swarm import clock
from swarm.recording.run import Run

LATENCY = 0.03
"""s one way, as the thesis' radio."""
ITERATIONS = 150
WARM_UP = 30
SIZE = 40
"""Bytes: a frame of lockstep."""
ROUNDS = 60


def one_way(radio: Radio, one: int, other: int) -> float:
    """s: half of a round trip's median over plain sockets of that link."""
    listener = rfcomm.Listener(rfcomm.Radio(radio.addresses[other], 7), {})
    caller = rfcomm.dial(rfcomm.Radio(radio.addresses[one], 7), radio.addresses[other])
    assert select.select([listener], [], [], 60)[0]
    called = listener.accept()
    times = []
    for _ in range(ROUNDS):
        began = time.perf_counter()
        for sender, receiver in ((caller, called), (called, caller)):
            sender.offer(bytes(SIZE))
            sender.flush()
            select.select([receiver], [], [], 60)
            receiver.read(clock.now())
            assert receiver.take(clock.now()) == bytes(SIZE)
        times.append(time.perf_counter() - began)
    for pipe in (caller, called):
        pipe.shutdown()
        pipe.close()
    listener.close()
    return statistics.median(times) / 2


def test_pace(processes: Processes, radio: Radio) -> None:
    radio.order("medium", latency=LATENCY)
    raw = statistics.median(one_way(radio, one, other) for one, other in LINE)
    swarm = Swarm(processes, "line")
    swarm.run(ITERATIONS)
    swarm.finish(ITERATIONS)
    found = Run(swarm.records).trajectories("consensus")
    swarm.close()
    spans = []
    for name in NAMES:
        times = found[name].times
        # Over two iterations: on a line single intervals alternate.
        spans += [(times[k + 2] - times[k]) / 2 for k in range(WARM_UP, ITERATIONS - 1)]
    iteration = statistics.median(spans)
    (Path(SHARE) / "pace.json").write_text(json.dumps({"iteration_s": iteration, "one_way_s": raw}))
