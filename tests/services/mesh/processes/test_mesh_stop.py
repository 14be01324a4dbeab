"""`swarm estop` and `swarm arm`: what counts as obeyed, and both between real meshes from one robot and from a run
directory."""

import argparse
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from conftest import CONFIG, stop, wait_until
from mesh_rig import Build, Robot, build
from test_mesh_overlay_process import LINE, wait_here

from laptop.cli import main
from services.balancer.core.control.estimation.gyro import Zero
from services.balancer.zero_file import ZeroFile
from swarm import clock
from swarm.messages import BalancerState, GraphRobot, Stop, Stopped, read
from swarm.onboard import halt
from swarm.onboard.halt import Row
from swarm.process.simulations import LOCK, claim

__all__ = ["build"]

Swarm = Callable[..., tuple[int, str]]

STATE = BalancerState(0.0, "balancing", 0.0, 0.0, 0.0, 0.0, 0.0, None, 1, 0.0, 0.0, "")


@pytest.fixture
def swarm(capsys: pytest.CaptureFixture[str]) -> Swarm:
    """The command; gives its exit code and what it printed."""

    def run(*arguments: str) -> tuple[int, str]:
        with pytest.raises(SystemExit) as ended:
            main(arguments)
        shown = capsys.readouterr()
        return int(ended.value.code or 0), shown.out + shown.err

    return run


def at(robot: Robot, monkeypatch: pytest.MonkeyPatch) -> None:
    """As on a robot: one bus, and no other."""
    for name, value in (("ROBOT", robot.name), ("RUNTIME", str(robot.directory)), ("CONFIG", str(robot.config))):
        monkeypatch.setenv(f"SWARM_{name}", value)


@pytest.mark.parametrize(
    ("words", "reason"), [((), halt.DEFAULT_REASON), (("smoke",), "smoke"), (("r1", "fell", "off"), "r1 fell off")]
)
def test_a_reason_without_quotes_stops_too(words: tuple[str, ...], reason: str) -> None:
    parser = argparse.ArgumentParser("estop")
    halt.add_arguments(parser)
    assert parser.parse_args(["stop", *words, "--timeout", "2"]).reason == reason


# -- what counts ---------------------------------------------------------------------------------------------


def known(state: str = "here", *, stopped: bool | None = None) -> GraphRobot:
    return GraphRobot("r0", state, 0.0, None, None, {}, stopped)


@pytest.mark.parametrize(
    ("there", "entry", "mode", "stops", "arms", "state"),
    [
        (True, known("self", stopped=True), None, True, False, "here"),
        (True, known("self", stopped=True), "fault", True, False, "here"),
        (True, known("self", stopped=True), "balancing", False, False, "here"),
        (True, known("self", stopped=True), "standing_up", False, False, "here"),
        (True, known("self", stopped=True), "lying_down", False, False, "here"),
        (True, known("self", stopped=False), "idle", False, True, "here"),
        (None, known(stopped=True), None, True, False, "here"),
        (None, known(stopped=None), None, False, True, "here"),
        (True, None, None, False, False, "silent"),
        (True, None, "fault", True, False, "silent"),
        (True, None, "balancing", False, False, "silent"),
        (False, None, None, False, False, "no bus"),
        (None, known("gone", stopped=True), None, False, False, "gone"),
        (True, known("left"), "idle", True, False, "silent"),
    ],
)
def test_what_counts_as_obeyed(
    there: bool | None, entry: GraphRobot | None, mode: str | None, stops: bool, arms: bool, state: str
) -> None:
    names = {} if there is None else {"r0": there}
    modes = {} if mode is None else {"r0": mode}
    for command, expected in ((True, stops), (False, arms)):
        entries = {} if entry is None else {"r0": entry}
        (row,) = halt.rows_of(names, entries, modes, stop=command, listened=True, running=())
        assert (row.confirmed, row.state) == (expected, state)


def test_a_balancer_that_may_not_have_been_heard_yet_is_waited_for() -> None:
    """A mesh that is stopped says nothing of the motors; where a bus can be reached its balancer's state comes soon."""
    entry = {"r0": known("self", stopped=True)}
    for names, expected in (({"r0": True}, False), ({"r0": False}, True), ({}, True)):
        (row,) = halt.rows_of(names, entry, {}, stop=True, listened=False, running=())
        assert row.confirmed is expected
    (row,) = halt.rows_of({"r0": True}, entry, {"r0": "fault"}, stop=True, listened=False, running=())
    assert row.confirmed


@pytest.mark.parametrize(("seconds", "runs"), [(0.5, True), (10.0, False), (-5.0, False)])
def test_a_loop_that_balances_without_a_bridge_keeps_its_robot_unconfirmed(
    tmp_path: Path, seconds: float, runs: bool
) -> None:
    """Nobody hears its state, but it says once a second that it uses its gyro's zero."""
    assert not halt.loop_runs(tmp_path)
    zeros = ZeroFile(tmp_path)
    zeros.keep(Zero(0.0, 0.0, 0.0), clock.now() - seconds)
    assert halt.loop_runs(tmp_path) is runs
    entry = {"r0": known("self", stopped=True)}
    (row,) = halt.rows_of({"r0": True}, entry, {}, stop=True, listened=True, running={"r0"} if runs else ())
    assert row.confirmed is not runs
    assert ("systemctl stop swarm-balancer" in halt.table([row], stop=True)[1]) is runs


@pytest.mark.parametrize(("systemd", "said"), [("true", "was stopped by systemd"), ("false", "systemctl stop swarm-b")])
def test_a_robot_whose_bus_is_gone_has_its_balancer_stopped_by_systemd(
    systemd: str, said: str, swarm: Swarm, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(halt, "DEFAULT_RUNTIME", tmp_path)
    monkeypatch.setattr(halt, "_END", (systemd,))
    monkeypatch.setattr("swarm.onboard.buses.ask.PATIENCE", 0.1)
    monkeypatch.setenv("SWARM_RUNTIME", str(tmp_path))
    monkeypatch.setenv("SWARM_ROBOT", "r0")
    monkeypatch.setenv("SWARM_CONFIG", str(tmp_path / "swarm.toml"))
    for config, problem in (("", "swarm.toml"), (CONFIG.format(runtime=tmp_path), "no bus is there")):
        (tmp_path / "swarm.toml").write_text(config)
        code, text = swarm("estop")
        assert code == 2
        assert problem in text
        assert said in text
    assert said not in swarm("arm")[1]


def test_the_table_says_who_has_not_obeyed_and_why() -> None:
    rows = [
        Row("r0", "here", True, "fault", True),
        Row("r1", "here", True, "balancing", False),
        Row("r2", "silent", None, None, False),
        Row("r3", "gone", None, None, False),
    ]
    text = halt.table(rows, stop=True)
    assert text[1].split() == ["r0", "here", "yes", "fault"]
    assert text[2].endswith("its motors are on")
    assert text[3].endswith("its mesh does not answer")
    assert text[4].endswith("out of reach")
    assert text[-1] == ("stopped: 1 of 4 robots; not confirmed: r1 r2; out of reach: r3 (told when they are back)")


# -- between real meshes -------------------------------------------------------------------------------------


def test_one_robots_bus_is_enough_to_stop_and_arm_all(
    build: Build, swarm: Swarm, monkeypatch: pytest.MonkeyPatch
) -> None:
    robots = build(edges=LINE)
    stops: list[Stop] = []
    robots["r3"].bus.subscribe("swarm/stop", lambda key, payload: stops.append(read(key, payload)))
    robots.start()
    wait_here(robots)
    at(robots["r1"], monkeypatch)
    code, text = swarm("estop", "smoke", "--timeout", "20")
    assert code == 0, text
    assert text.splitlines()[-1] == "stopped: 4 of 4 robots"
    wait_until(lambda: stops)
    assert (stops[0].origin, stops[0].reason) == ("r1", "smoke")
    code, text = swarm("arm", "--json", "--timeout", "20")
    shown = json.loads(text)
    assert (code, shown["confirmed"], shown["stop"]) == (0, True, False)
    assert [(each["robot"], each["stopped"]) for each in shown["robots"]] == [(f"r{n}", False) for n in range(4)]
    # One whose motors are on has not obeyed, whatever its mesh says; one that is away is said to be.
    robot = robots["r3"]
    assert robot.mesh is not None
    assert stop(robot.mesh) == 0
    ended = False

    def balance(key: str, payload: bytes) -> None:
        robots["r1"].bus.publish("swarm/r1/balancer/state", STATE if not ended else replace(STATE, mode="fault"))

    robots["r1"].bus.subscribe("swarm/r1/mesh/stopped", balance)
    code, text = swarm("estop", "--timeout", "4")
    assert code == 1
    assert "its motors are on" in text
    assert "out of reach: r3" in text
    ended = True
    code, text = swarm("estop", "--timeout", "20")
    assert code == 0, text


def test_meshes_that_are_killed_together_are_still_stopped_when_they_start(
    build: Build, swarm: Swarm, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Even before a robot has a link over which it could hear of the stop, and after a boot."""
    robots = build(edges=LINE[:1])
    robots.start()
    robots.wait_up()
    at(robots["r0"], monkeypatch)
    code, text = swarm("estop", "smoke", "--timeout", "20")
    assert code == 0, text
    for name in ("r0", "r1"):
        mesh = robots[name].mesh
        assert mesh is not None
        mesh.kill()
        mesh.wait()
        for entry in robots[name].directory.iterdir():
            if entry.is_file():  # of the runtime directory a boot leaves nothing; the router of the test lives on
                entry.unlink()
    told: list[Stopped] = []
    robots["r0"].bus.subscribe("swarm/r0/mesh/stopped", lambda key, payload: told.append(read(key, payload)))
    robots["r0"].start()
    wait_until(lambda: len(told) > 1, what="the mesh tells twice whether it is stopped")
    assert {tuple(each.by.items()) for each in tuple(told)} == {(("r0", "smoke"),)}
    robots["r1"].start()
    code, text = swarm("arm", "--timeout", "20")
    assert code == 0, text


def test_a_run_directory_reaches_robots_whose_meshes_are_dead(build: Build, swarm: Swarm) -> None:
    robots = build(edges=LINE[:2])
    heard: list[str] = []
    robots["r2"].bus.subscribe("swarm/stop", lambda key, payload: heard.append(read(key, payload).reason))
    robots["r0"].start()
    robots["r1"].start()
    (robots.runtime / LOCK).touch()
    with claim(robots.runtime):

        def is_silent() -> bool:
            """Again where r2's bus could not be reached in time."""
            code, text = swarm("estop", "--run-dir", str(robots.runtime), "--timeout", "2", "--json")
            assert code == 1, text
            (row,) = (each for each in json.loads(text)["robots"] if each["robot"] == "r2")
            return (row["state"], row["confirmed"]) == ("silent", False)

        wait_until(is_silent, what="r2 is told as silent")
        wait_until(lambda: heard, what="the stop is on r2's bus")
        assert set(heard) == {"swarm estop"}
        robots["r2"].start()
        code, text = swarm("estop", "again", "--run-dir", str(robots.runtime), "--timeout", "20")
        assert code == 0, text
        code, text = swarm("arm", "--run-dir", str(robots.runtime), "--robots", "r2", "--timeout", "20")
        assert code == 0, text
    code, text = swarm("estop", "--run-dir", str(robots.runtime))
    assert code == 2
    assert "no simulation is running" in text
