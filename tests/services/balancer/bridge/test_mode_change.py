"""What `swarm balance` says of a robot: by the balancer's own messages, under virtual time."""

import pytest
from balancer_rig import Rig
from hypothesis import given
from hypothesis import strategies as st

from services.balancer.bridge.orders import halt, obey
from services.balancer.core import faults
from services.balancer.core.devices.battery import EMPTY
from services.balancer.telemetry import Telemetry
from swarm.messages import BalancerFault, BalancerState, Notice, SetMode, Stop
from swarm.onboard.body.mode_change import COMMANDS, ModeChange, ModeOutcome


def state(mode: str, t: float = 0.0) -> BalancerState:
    return BalancerState(t, mode, 0.0, 0.0, 0.0, 0.0, 0.0, 7.4, 1, 0.0, 0.0, "")


class Quiet:
    """A log that nobody reads."""

    def info(self, *_: object) -> None:
        pass


def commanded(rig: Rig, command: str, seconds: float = 40.0, *, stopped: bool = False) -> ModeOutcome:
    """Give the command to a balancer of the rig as `swarm balance` does; a stop that holds is said each second."""
    change = ModeChange(command)
    telemetry = Telemetry(rig.balancer, "lqr")
    for tick in range(round(seconds * 100)):
        rig.run(0.01)
        if stopped and tick % 100 == 99:
            halt(rig.balancer, Stop(rig.now, "r9", "test"))
        if tick % 4 == 0:
            change.receive(telemetry.state(rig.tick, 0, 0, (0.0, 0.0), ""))
        if (news := telemetry.news()) is not None:
            change.receive(news)
        if tick % 100 == 49 and rig.balancer.fault is not None:
            change.receive(telemetry.fault())
        if change.due(rig.now):
            obey(rig.balancer, SetMode(COMMANDS[command]), rig.now, Quiet())
        if change.outcome is not None:
            break
    return change.give_up(seconds)


def idle(**arguments: object) -> Rig:
    return Rig(start_mode="rest", **arguments).run(4.0)


def test_a_robot_that_lies_stands_up_and_lies_down_again() -> None:
    rig = idle(tilt=-1.9, held=False)
    assert commanded(rig, "stand") == ModeOutcome(True, "stands")
    assert commanded(rig, "stand") == ModeOutcome(True, "stands")  # it does already
    assert commanded(rig, "lie").ok
    assert rig.balancer.mode == "idle"
    rig.run(2.0)  # until it has come to rest
    assert commanded(rig, "zero") == ModeOutcome(True, "the gyro's zero is found")


def test_a_robot_leaves_a_fault_by_standing_up() -> None:
    rig = idle()
    assert commanded(rig, "stand").ok
    rig.body.lay(-1)
    rig.run(2.0)
    assert rig.balancer.fault is not None
    assert commanded(rig, "stand").ok


def test_a_stop_that_holds_is_named_with_the_commands_that_end_it() -> None:
    outcome = commanded(idle(tilt=-1.9, held=False), "stand", stopped=True)
    assert not outcome.ok
    assert outcome.text == "stopped: test (by r9): take the stop back (swarm arm), then swarm balance stand"


def test_a_robot_with_an_empty_battery_refuses_and_says_why() -> None:
    rig = idle()
    rig.balancer.battery = 5.0
    for second in range(12):  # the best reading of the last 10 s counts
        rig.balancer.watch_battery(rig.now + second)
    assert rig.balancer.battery_level == EMPTY
    outcome = commanded(rig, "stand")
    assert (outcome.ok, "battery empty: " in outcome.text) == (False, True)


def test_a_robot_whose_devices_do_not_answer_refuses_and_says_why() -> None:
    rig = idle()
    rig.robot.devices.clear()
    rig.run(1.0)
    outcome = commanded(rig, "stand", 5.0)
    assert not outcome.ok
    assert "swarm " in outcome.text


@pytest.mark.parametrize(("command", "way_out"), [("lie", "swarm balance rest"), ("zero", ": swarm balance lie")])
def test_what_cannot_be_done_now_is_refused_with_a_way_out_that_lets_no_robot_fall(command: str, way_out: str) -> None:
    rig = idle()
    assert commanded(rig, "stand").ok
    if command == "lie":
        assert commanded(rig, "rest").ok
    outcome = commanded(rig, command, 10.0)
    assert not outcome.ok
    assert way_out in outcome.text


def test_a_silent_balancer_is_named() -> None:
    change = ModeChange("stand")
    change.silent()
    assert change.outcome == ModeOutcome(False, "its balancer does not answer: swarm doctor tells why")


MESSAGES = st.one_of(
    st.builds(state, st.sampled_from(["idle", "standing_up", "balancing", "lying_down", "fault", "calibrating"])),
    st.sampled_from([BalancerFault(0.0, name, "why", text) for name, text in faults.RECOVERY.items()]),
    st.builds(Notice, st.just(0.0), st.sampled_from(["mode", "calibrate", "velocity"]), st.text(max_size=5)),
)


@given(st.sampled_from(sorted(COMMANDS)), st.lists(MESSAGES, max_size=20))
def test_every_refusal_names_a_command_whatever_a_balancer_says(command: str, messages: list[object]) -> None:
    change = ModeChange(command)
    for number, message in enumerate(messages):
        change.receive(message)
        change.due(float(number))
    outcome = change.give_up(1.0)
    assert outcome.text
    assert outcome.ok or "swarm " in outcome.text
