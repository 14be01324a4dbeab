"""Robots that stay away, come back, or fail, as processes: the others go on without them and take them in again."""

import shutil
import signal

import pytest
from apps_rig import NAMES, Rig
from conftest import wait_until
from host_rig import START, MakeRig, ask, make_rig

from swarm.messages import AppEpoch, AppState, SetAppEpoch, Status

__all__ = ["make_rig"]

DROP = ("--absent", "drop", "--drop-after", "1.5")


def full(rig: Rig) -> None:
    """Links between all three."""
    rig._relay("r0", "r2")
    rig._relay("r2", "r0")
    rig.set_topology(("r0", "r1"), ("r0", "r2"), ("r1", "r2"))


def until_members(rig: Rig, names: tuple[str, ...], *of: str) -> None:
    rig.until(lambda: all(n in rig.epochs and rig.epochs[n].members == names for n in of), f"members {names}")


def test_a_robot_that_dies_is_dropped_and_one_that_comes_back_is_taken_in(make_rig: MakeRig) -> None:
    """First killed, then rebooted: its runtime directory is empty, what it has voted is not."""
    rig = make_rig(START)
    full(rig)
    state = str(rig.directory / "state")
    for name in NAMES:
        rig.start(name, "apps", "consensus", *DROP, "--run", "77", SWARM_STATE=f"{state}.{name}")
    rig.until_k(20)
    rig.kill("r2")
    until_members(rig, ("r0", "r1"), "r0", "r1")
    k = rig.state["r0"].k
    rig.until_k(k + 50, "r0", "r1")
    # Metropolis on two robots: both end on the mean of what they had.
    assert abs(rig.state["r0"].state["value"] - rig.state["r1"].state["value"]) < 1e-9
    for file in (rig.directory / "r2").glob("app.*"):
        file.unlink()
    rig.start("r2", "apps", "consensus", *DROP, "--run", "77", SWARM_STATE=f"{state}.r2")
    until_members(rig, NAMES, *NAMES)
    k = rig.state["r0"].k
    rig.until_k(k + 50)
    assert len({ask(rig, name, "consensus/epoch", AppEpoch).frames for name in NAMES}) == 1
    assert "has lost its state of the run" in rig.log("r2")
    shutil.rmtree(f"{state}.r2")


@pytest.mark.slow  # tests/sim/virtual/test_virtual_members.py does so under virtual time
def test_an_operator_sends_a_robot_away_and_lets_it_come_back(make_rig: MakeRig) -> None:
    rig = make_rig(START)
    full(rig)
    rig.start_all("consensus")
    rig.until_k(5)
    drop = rig.launch("r0", "cli", ["-m", "laptop.cli", "mesh", "epoch", "drop", "r1", "--app", "consensus"])
    assert drop.wait(60) == 0
    assert "r0  epoch 1 from iteration" in rig.log("r0", "cli")
    until_members(rig, ("r0", "r2"), *NAMES)
    rig.until(
        lambda: rig.progress["r1"].reason == "r1 is not in epoch 1: only the operator lets it in again", "r1 says so"
    )
    k = rig.state["r0"].k
    rig.until_k(k + 30, "r0", "r2")
    assert ask(rig, "r0", "consensus/epoch", AppEpoch).epoch == 1
    order = SetAppEpoch("two", (), ("r1",), force=False)
    for _ in range(2):  # a repetition is not done again
        rig.buses["r2"].publish("swarm/r2/app/consensus/set/epoch", order)
    until_members(rig, NAMES, *NAMES)
    k = rig.state["r1"].k
    rig.until_k(k + 30)
    assert ask(rig, "r0", "consensus/epoch", AppEpoch).epoch == 2


def test_a_step_that_hangs_is_named_and_the_others_go_on(make_rig: MakeRig) -> None:
    rig = make_rig("")
    full(rig)
    app = rig.directory / "lazy.py"
    app.write_text(
        "import threading\nfrom services.apps.host import lockstep_driver\nfrom swarm import SyncApp\n"
        "class Lazy(SyncApp):\n    value: float\n    def step(self, neighbours):\n"
        "        if self.robot.name == 'r1' and self.k == 7:\n"
        "            lockstep_driver.HANG = 0.5\n"
        "            threading.Event().wait()\n"
    )
    rig.start_all(str(app), *DROP)
    rig.until_phase("fault", "r1")
    reason = rig.progress["r1"].reason
    assert reason.startswith("Lazy on r1, iteration 7: /")
    assert reason.endswith(".py, line 9, in step(): it has not ended within 0.5 s")
    rig.until_k(30, "r0", "r2")
    assert rig.stop("r1") == 3


SPINNING = """
from services.apps.host import lockstep_driver
from swarm import SyncApp
lockstep_driver.HANG = 0.5
class Spinning(SyncApp):
    value: float
    def step(self, neighbours):
        self.robot.truth = lambda: 1
    def {method}(self, *truth):
        while self.k == 7: pass
        return {answer}
"""


@pytest.mark.parametrize(
    ("method", "answer"), [("result", '{"value": self.value}'), ("converged", "False"), ("error_far", "0.0")]
)
def test_what_hangs_beside_the_step_is_named_and_the_process_stops(make_rig: MakeRig, method: str, answer: str) -> None:
    rig = make_rig("", ("r0",))
    app = rig.directory / "spinning.py"
    app.write_text(SPINNING.format(method=method, answer=answer))
    rig.start("r0", "apps", str(app), "--until", "converged")
    rig.until_phase("fault", "r0")
    where = f"Spinning on r0, {method}() at iteration 7: {app}, line 10, in {method}()"
    assert rig.progress["r0"].reason == f"{where}: it has not ended within 0.5 s"
    assert ask(rig, "r0", "spinning/state", AppState).k == 6
    assert rig.stop("r0") == 3


def test_weights_that_hang_when_an_app_goes_on_from_a_snapshot_are_named(make_rig: MakeRig) -> None:
    rig = make_rig("")
    app = rig.directory / "weighing.py"
    app.write_text(
        "import pathlib\nfrom services.apps.host import lockstep_driver\nfrom swarm import SyncApp\n"
        "lockstep_driver.HANG = 0.5\n"
        "class Weighing(SyncApp):\n    value: float\n    def step(self, neighbours):\n        pass\n"
        "    def neighbour_weights(self):\n"
        f"        while len(self.robot.swarm) == 2 and pathlib.Path({str(rig.directory / 'spin')!r}).exists(): pass\n"
        "        return super().neighbour_weights()\n"
    )
    rig.start_all(str(app), *DROP)
    rig.until_k(3)
    rig.kill("r2")
    until_members(rig, ("r0", "r1"), "r0", "r1")
    k = rig.state["r0"].k
    rig.until_k(k + 5, "r0")
    rig.kill("r0")
    (rig.directory / "spin").write_text("")
    rig.start("r0", "apps", str(app), *DROP)
    rig.until_phase("fault", "r0")
    assert ", line 10, in neighbour_weights(): it has not ended within 0.5 s" in rig.progress["r0"].reason
    assert rig.stop("r0") == 3


def test_sigterm_ends_an_app_whose_weights_hang_when_it_is_made(make_rig: MakeRig) -> None:
    rig = make_rig("")
    app, spins = rig.directory / "weighing.py", rig.directory / "spins"
    app.write_text(
        "import pathlib\nfrom swarm import SyncApp\n"
        "class Weighing(SyncApp):\n    value: float\n    def step(self, neighbours):\n        pass\n"
        "    def neighbour_weights(self):\n"
        f"        pathlib.Path({str(spins)!r}).touch()\n"
        "        while True: pass\n"
        "import sys\nsys.modules['__main__'].HANG = 0.5\n"
    )
    rig.start("r0", "apps", str(app))
    wait_until(spins.exists, what="the weights are asked for")
    line = f"{app}, line 9, in neighbour_weights(): the app is not made within 0.5 s"
    wait_until(lambda: ask(rig, "r0", "weighing/status", Status).reason == line, what="the line is named")
    assert rig.stop("r0") == 0


def test_weights_that_raise_when_an_app_is_made_are_a_fault_of_the_app(make_rig: MakeRig) -> None:
    rig = make_rig("")
    app = rig.directory / "weighing.py"
    app.write_text(
        "from swarm import SyncApp\nclass Weighing(SyncApp):\n    value: float\n"
        "    def step(self, neighbours):\n        pass\n"
        "    def neighbour_weights(self):\n        return {'r0': 1 / (len(self.robot.swarm) - 3)}\n"
    )
    assert rig.start("r0", "apps", str(app)).wait(60) == 2
    assert f"app weighing on r0: {app}, line 7: ZeroDivisionError: division by zero" in rig.log("r0")


def test_an_app_that_diverges_is_named(make_rig: MakeRig) -> None:
    rig = make_rig("[apps.wild]\ndiverges_above = 1e6\n")
    app = rig.directory / "wild.py"
    app.write_text(
        "from swarm import SyncApp\nclass Wild(SyncApp):\n    x: float = 1.0\n"
        "    def step(self, neighbours):\n        self.x *= -3\n"
    )
    rig.start_all(str(app))
    rig.until_phase("fault")
    text = "x: -1594323.0 is beyond diverges_above = 1e+06: the app diverges"
    reason = f"Wild on r1, iteration 12: {app}, from line 4 on: {text}"
    assert rig.progress["r1"].reason == reason


def test_all_stop_at_the_same_iteration_when_they_have_converged(make_rig: MakeRig) -> None:
    rig = make_rig(START)
    rig.start_all("consensus", "--until", "converged", "--rounds", "5", "--tolerance", "1e-6")
    rig.until_phase("done")
    ends = {name: ask(rig, name, "consensus/state", AppState) for name in NAMES}
    assert len({state.k for state in ends.values()}) == 1
    assert all(abs(state.state["value"] - 8.5 / 3) < 1e-4 for state in ends.values())


def test_all_stop_at_the_same_iteration_when_the_time_is_up(make_rig: MakeRig) -> None:
    rig = make_rig(START)
    rig.start_all("consensus", "--for", "1.5")
    rig.until_k(5)
    rig.kill("r1")
    rig.start("r1", "apps", "consensus", "--for", "1.5")
    rig.processes["r2", "apps"].send_signal(signal.SIGSTOP)
    rig.processes["r2", "apps"].send_signal(signal.SIGCONT)
    rig.until_phase("done")
    assert len({ask(rig, name, "consensus/state", AppState).k for name in NAMES}) == 1
