"""Commissioning of simulated robots under virtual time: one that is well, and each fault is named in time."""

import argparse
import json
import math
import re
from pathlib import Path
from unittest.mock import MagicMock

import pytest
from commission_world import ANCHORS, OFFSET, World
from conftest import thinned

from services.dwm.calibrate import making
from sim.core.actions import MISWIRINGS
from sim.scenario import commission_report
from swarm.messages import Stop, Stopped, TryMotors
from swarm.onboard.commission import command
from swarm.onboard.commission.core.procedure import PASSED, StepResult
from swarm.onboard.halt import Row

LOW_POWER = 0.2
"""Duty that no motor may exceed before the robot stands."""


def test_a_robot_that_is_well_passes_every_step_and_stands(tmp_path: Path) -> None:
    world = World().run()
    report = world.procedure.report()
    path = tmp_path / "report.json"
    path.write_text(json.dumps(report))
    like = commission_report.read(path)
    assert like.scl == pytest.approx(100e3, rel=0.2)
    assert (like.latency, like.battery) == (0.0155, 7.4)
    assert like.gyro_noise == pytest.approx(math.radians(7e-3 * math.sqrt(104)), rel=0.5)
    assert like.range_noise == pytest.approx(0.02, rel=0.5)
    assert report["verdict"] == "passed", world.said[-5:]
    assert [row["verdict"] for row in report["steps"]] == ["passed"] * len(report["steps"])
    assert world.balancer.mode == "idle"
    assert world.figures("bus")["scl_hz"] == pytest.approx(100e3, rel=0.2)
    assert world.figures("battery") == {"battery_v": 7.4}
    assert world.figures("stop")["stopped_s"] < 0.5
    assert 0.15 < world.figures("watchdog")["stopped_s"] < 0.8
    assert set(world.figures("uwb")["anchors"]) == set(ANCHORS)
    assert world.figures("offset")["range_offset_m"] == pytest.approx(OFFSET, abs=0.02)
    assert making.offset_of(path, "r0").offset == world.figures("offset")["range_offset_m"]
    assert world.figures("radio") == {"round_trips_ms": {"r1": 31.0}}
    assert world.figures("standing")["tilt_rms_deg"] < 1.0


NAMED = {
    "left-motor": ("motors", "the left motor is reversed"),
    "right-motor": ("motors", "the right motor is reversed"),
    "left-encoder": ("encoders", "the left encoder is reversed"),
    "right-encoder": ("encoders", "the right encoder is reversed"),
    "imu-upside-down": ("imu", "upside down"),
    "imu-backward": ("imu", "backward"),
    "imu-mirrored": ("imu", "mirrored"),
}


REMEDIES = {
    "left-motor": "set flip_left_motor = true in [balancing.robots.r0] of swarm.toml",
    "right-motor": "set flip_right_motor = true in [balancing.robots.r0] of swarm.toml",
    "left-encoder": "Forward is the way in which the battery cover faces",
    "right-encoder": "Forward is the way in which the battery cover faces",
}
"""What a person can do. The encoders' sensors are on the Balboa's board, so no wire of them can be changed."""


@pytest.mark.parametrize("part", thinned(MISWIRINGS))
def test_a_part_that_is_mounted_wrong_is_named_and_no_motor_reaches_full_power(part: str) -> None:
    world = World()
    world.robot.miswire(part, back=False)
    world.run()
    step, text, remedy = world.failed
    assert (step, NAMED[part][1] in text) == (NAMED[part][0], True), text
    assert REMEDIES.get(part, "") in remedy
    assert world.largest_duty <= LOW_POWER
    assert world.balancer.mode == "idle"
    assert "stand-on-floor" not in world.asked


@pytest.mark.parametrize("part", thinned(["left-motor", "right-encoder"]))
def test_a_step_is_tried_again_once_its_fault_is_mended_and_the_robot_stands(part: str) -> None:
    world = World()
    world.robot.miswire(part, back=False)

    def mend(world: World) -> bool:
        world.robot.miswire(part, back=True)
        return True

    world.mend = mend
    report = world.run().procedure.report()
    assert report["verdict"] == "passed"
    assert [row["tries"] for row in report["steps"] if row["name"] == NAMED[part][0]] == [2]


def test_a_dead_anchor_is_named() -> None:
    world = World(anchors=ANCHORS[:2]).run()
    step, text, remedy = world.failed
    assert (step, text) == ("uwb", "not heard: anchor 4F21")
    assert "is it powered" in remedy
    assert world.largest_duty <= LOW_POWER


@pytest.mark.slow
def test_an_anchor_that_stands_elsewhere_is_named_by_the_offsets_step() -> None:
    world = World()
    world.wrong["D10A"] = 0.8
    step, text, remedy = world.run().failed
    assert step == "offset"
    assert "ranges to anchor D10A are +0.8" in text
    assert "does D10A stand where swarm.toml says?" in remedy


def test_a_robot_that_is_laid_elsewhere_learns_no_offset() -> None:
    world = World()
    world.wrong = dict.fromkeys(ANCHORS, 0.7)
    step, text, remedy = world.run().failed
    assert (step, "no module errs by more than 0.5 m" in text) == ("offset", True)
    assert "at the places that are named" in remedy


def test_the_offset_may_be_left_out() -> None:
    world = World()
    world.declined.add("lay-at")
    assert world.run().procedure.passed
    assert world.figures("offset") == {}
    assert "stand-on-floor" in world.asked


@pytest.mark.parametrize("scl", [40e3, 62.5e3])
def test_a_slow_bus_is_named_with_its_clock(scl: float) -> None:
    world = World(scl=scl).run()
    step, text, remedy = world.failed
    assert step == "bus"
    named = re.search(r"SCL is some (\d+) kHz in place of 100", text)
    assert named is not None, text
    assert float(named[1]) * 1e3 == pytest.approx(scl, rel=0.1)
    assert "swarm provision" in remedy
    assert world.largest_duty == 0.0
    assert world.procedure.report()["steps"][2]["verdict"] == "not tried"


def test_an_unplugged_imu_and_an_empty_battery_are_named() -> None:
    world = World()
    world.robot.devices.pop(0x6B)
    assert world.run().failed[0] == "ready"
    world = World()
    world.robot.atmega.battery = 6.2
    assert world.run().failed[:2] == ("battery", "the battery has 6.20 V, expected 6.6 to 10")


def test_a_person_may_say_no_at_any_question_and_nothing_turns() -> None:
    world = World()
    for _ in range(50):
        world._run_tick()
    world._do(world.procedure.answer(False, world.now))
    assert world.run().failed[:2] == ("ready", "the person has said no")
    assert world.largest_duty == 0.0


def test_button_a_confirms_and_button_c_declines() -> None:
    for button, ended in ((1, False), (4, True)):
        world = World()
        for _ in range(30):
            world._run_tick()
        world._acts.clear()  # the person answers by no key
        world.robot.atmega.press(button)
        for _ in range(30):
            world._run_tick()
        assert bool(world.procedure.results) == ended


@pytest.mark.parametrize("by", [{"r1": "smoke"}, {"r0": "the page"}, {"r0": "swarm commission", "r1": "smoke"}])
def test_a_stop_of_somebody_else_is_not_taken_back(by: dict[str, str]) -> None:
    world = World()
    obey = world._command

    def stopped(message: object) -> None:
        obey(message)
        if isinstance(message, Stop):
            world._tell(Stopped(world.now, True, by))

    world._command = stopped  # type: ignore[method-assign]
    world.run()
    step, text, remedy = world.failed
    assert step == "stop"
    assert "somebody else has stopped the swarm" in text
    assert "swarm arm" in remedy
    assert world._stop is not None


def test_a_stop_given_just_before_that_of_the_step_is_not_taken_back() -> None:
    """The step's own stop would take its place, and the arm would take back both."""
    world = World()
    obey = world._command

    def turning(message: object) -> None:
        obey(message)
        if isinstance(message, TryMotors) and (message.kind, message.seconds) == ("turn", 3.0):
            world._tell(Stopped(world.now, True, {"r0": "smoke"}))

    world._command = turning  # type: ignore[method-assign]
    world.run()
    assert world.failed[:2] == ("stop", "it was stopped before this step did so")


def test_wheels_that_do_not_stop_are_named_before_a_stop_of_somebody_else() -> None:
    world = World()

    def deaf(message: object) -> None:
        if isinstance(message, Stop):
            world._tell(Stopped(world.now, True, {"r1": "smoke"}))
        else:
            obey(message)

    obey, world._command = world._command, deaf  # type: ignore[method-assign]
    world.run()
    assert world.failed[:2] == ("stop", "a stop does not stop the wheels")
    assert world.balancer.mode == "idle"


def stopped_by_space(folder: Path, monkeypatch: pytest.MonkeyPatch, give: MagicMock) -> str:
    """Run `swarm commission`, in which a person presses Space; what the report's `ended` says."""
    for what in ("Bus", "_Session", "config_for", "subject_of"):
        monkeypatch.setattr(command, what, MagicMock())
    command._Session.return_value.run.return_value = command.STOPPED  # type: ignore[attr-defined]
    monkeypatch.setattr(command, "one", lambda _: ("r0", folder / "r0"))
    monkeypatch.setattr(command, "Procedure", lambda *_: World().procedure)
    monkeypatch.setattr(command.buses, "directories_of", lambda _: {"r0": folder / "r0", "r1": folder / "r1"})
    monkeypatch.setattr(command.halt, "stop_or_arm", give)
    try:
        assert command.run(argparse.Namespace(json=False, out=folder / "report.json", run_dir=None)) == 1
    finally:
        ended = json.loads((folder / "report.json").read_text())["ended"]
    assert isinstance(ended, str)
    return ended


def test_the_report_names_the_robots_that_have_not_confirmed_the_persons_stop(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rows = [Row("r0", "here", True, "idle", True), Row("r1", "silent", None, None, False)]
    give = MagicMock(return_value=rows)
    ended = stopped_by_space(tmp_path, monkeypatch, give)
    assert list(give.call_args.args[0]) == ["r0", "r1"], "each is told on its own bus"
    assert ended.startswith(f"{command.STOPPED}; not confirmed by r1: ")
    assert stopped_by_space(tmp_path, monkeypatch, MagicMock(return_value=rows[:1])) == command.STOPPED
    lost = [Row("r0", "no bus", None, None, False)]  # its bus has ended meanwhile
    assert "not confirmed by r0" in stopped_by_space(tmp_path, monkeypatch, MagicMock(return_value=lost))


def test_the_report_is_written_also_when_the_person_does_not_wait_until_the_stop_is_confirmed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(KeyboardInterrupt):
        stopped_by_space(tmp_path, monkeypatch, MagicMock(side_effect=KeyboardInterrupt))
    assert "not all robots have confirmed" in json.loads((tmp_path / "report.json").read_text())["ended"]


def test_a_laptop_gets_the_report_after_each_step(capsys: pytest.CaptureFixture[str]) -> None:
    world = World()
    session = command._Session(MagicMock(), "r0", world.procedure, as_json=True)
    session._do([])
    assert not capsys.readouterr().out
    for name in ("ready", "bus"):
        world.procedure.results[name] = StepResult(name, PASSED, 1, {})
        session._do([])
        session._do([])
        (line,) = capsys.readouterr().out.splitlines()
        assert json.loads(line)["so_far"] == world.procedure.report()
