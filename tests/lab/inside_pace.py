"""Inside a machine: an iteration beside what the same links take one way. A figure, not a test: bench/lab.py."""

import json
import select
import statistics
import time

import pytest
from conftest import Processes
from inside_swarm import NAMES, SHARE, Swarm

from lab.radio.remote import Radio
from lab.shapes import LINE
from services.mesh.links import rfcomm
from swarm import clock
from swarm.recording.run import Run

LATENCIES = (0.03, 0.1)
"""s one way: the thesis' radio, and where computing is less of it."""
ITERATIONS = 120
WARM_UP = 30
SIZE = 40
"""Bytes: a frame of lockstep."""
ROUNDS = 40


def one_way(radio: Radio, one: int, other: int) -> float:
    """s: half of a round trip's median over plain sockets of that link."""
    listener = rfcomm.RfcommListener(rfcomm.Radio(radio.addresses[other], 7), {})
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


@pytest.mark.parametrize("latency", LATENCIES)
def test_an_iteration_takes_as_long_as_the_radio_lets_it(processes: Processes, radio: Radio, latency: float) -> None:
    radio.order("medium", latency=latency)
    raw = statistics.median(one_way(radio, one, other) for one, other in LINE[:2])
    swarm = Swarm(processes, "line")
    swarm.run(ITERATIONS)
    swarm.wait_reached("the end of the run", ITERATIONS)
    swarm.end()
    found = Run(swarm.records).trajectories("consensus")
    swarm.close()
    spans = []
    for name in NAMES:
        times = found[name].times
        # Over two iterations: on a line single intervals alternate.
        spans += [(times[k + 2] - times[k]) / 2 for k in range(WARM_UP, ITERATIONS - 1)]
    figures = {"latency_s": latency, "iteration_s": statistics.median(spans), "one_way_s": raw}
    with (SHARE / "pace").open("a") as file:
        file.write(json.dumps(figures) + "\n")
