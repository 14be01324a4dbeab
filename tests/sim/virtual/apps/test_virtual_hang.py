"""Code of an author that does not return, under virtual time: broken off, and named with robot, iteration and line."""

import re
import threading

import pytest

from sim.virtual.apps import hang
from sim.virtual.run import run_virtually
from swarm.recording.run import Run

SYNC = """\
import time
from swarm import SyncApp


class Hanging(SyncApp):
    value: float = 0.0

    def step(self, neighbours):
        if self.robot.name == "r1" and self.k == 7:
            {how}
        self.value += 1.0
"""
PERIODIC = """\
from swarm import PeriodicApp


class Hanging(PeriodicApp):
    lit: bool = False
    period = 0.1

    def step(self, neighbours):
        while self.robot.name == "r1" and self.k == 3:
            pass
"""
LOOP = "while True: pass"


@pytest.fixture(autouse=True)
def soon(monkeypatch):
    """Nobody waits for ten seconds here."""
    monkeypatch.setattr(hang, "LOOK_S", 0.02)
    monkeypatch.setattr(hang, "HANG", 0.5)


def app(tmp_path, text):
    path = tmp_path / "hanging.py"
    path.write_text(text)
    return str(path)


@pytest.mark.parametrize("how", [LOOP, "time.sleep(100)"])
def test_a_step_that_hangs_is_named(tmp_path, how):
    words = ("--robots", "3", "--iterations", "20", "--record", str(tmp_path / "run"))
    report, outcome = run_virtually(app(tmp_path, SYNC.format(how=how)), *words, rows=True)
    (problem,) = report["problems"]
    assert problem.startswith("Hanging on r1, iteration 7: ")
    assert "hanging.py, line 10: Hangs: it has not ended within" in problem
    assert outcome.trajectories["r1"].last == 7
    # The recording is kept, and says the same.
    recorded = Run(tmp_path / "run")
    assert recorded.trajectories()["r1"].last == 7
    told = [sample.message for sample in recorded.samples("swarm/r1/app/*/progress")]
    assert [message["phase"] for message in told] == ["running", "fault"]
    assert told[-1]["reason"] in problem


def test_the_others_go_on_where_they_may(tmp_path):
    drop = ("--absent", "drop", "--drop-after", "1")
    words = ("--robots", "3", "--topology", "full", "--iterations", "200", *drop)
    report, outcome = run_virtually(app(tmp_path, SYNC.format(how=LOOP)), *words, rows=True)
    assert report["missing"] == ["r1"]
    assert [outcome.trajectories[name].last for name in ("r0", "r1", "r2")] == [200, 7, 200]


def test_a_handler_that_hangs_is_named(tmp_path):
    report, _ = run_virtually(app(tmp_path, PERIODIC), "--robots", "2", "--seconds", "3")
    (problem,) = report["problems"]
    assert "Hanging on r1, step 3: " in problem
    assert re.search("line (9|10): Hangs", problem)


def test_a_hanging_app_is_stopped_in_another_thread_too(tmp_path):
    """As a worker of Dask runs it."""
    found = []
    path = app(tmp_path, SYNC.format(how=LOOP))
    thread = threading.Thread(target=lambda: found.append(run_virtually(path, "--robots", "2", "--iterations", "20")))
    thread.start()
    thread.join()
    assert "iteration 7" in found[0][0]["problems"][0]


def test_steps_that_end_are_left_alone(tmp_path):
    """Many that together take longer than one may."""
    path = app(tmp_path, SYNC.format(how="pass").replace("self.value += 1.0", "time.sleep(0.02)"))
    report, _ = run_virtually(path, "--robots", "2", "--iterations", "20")
    assert report["problems"] == []
