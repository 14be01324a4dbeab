"""What ends a run of processes before its time; no process is started."""

import signal
import socket
import sys
from pathlib import Path
from typing import Any

import msgpack
import pytest

from sim.processes.monitor import Monitor
from sim.processes.run import ProcessRun
from sim.scenario.options import parse
from sim.scenario.scenario import build
from swarm import clock


def test_a_defect_of_the_world_ends_the_run_and_is_its_problem(
    runtime: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Else its robots would stay where they were last seen, and the run would call that its outcome."""

    def publish(*_: object) -> None:
        raise TypeError("what is not expected")

    monkeypatch.setattr(Monitor, "truth", publish)
    monkeypatch.setattr(signal, "signal", lambda *_: None)  # the end of a run ignores Ctrl-C from then on
    options = parse(["--robots", "1", "--seconds", "999"])
    run: Any = ProcessRun(options, build(options, runtime), runtime, sys.stderr)
    run._commanded = clock.now()  # or it has no time left to start when the first look comes
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as body:
            pose = {"robot": "r0", "t": 1.0, "x": 1.0, "y": 2.0, "heading": 3.0, "tilt": 0.1, "held": False}
            body.sendto(msgpack.packb(pose), str(runtime / "world.sock"))
        outcome = run.watch()
    finally:
        run.__exit__()
    assert outcome.problems == ("defect of the world: TypeError('what is not expected')",)
    assert "the world has a defect" in caplog.text
