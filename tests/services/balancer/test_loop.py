"""The loop on a virtual clock with a bridge made of lists: what it does when, and what it leaves out when late."""

import contextlib
import errno
import gc
import math
import os
from itertools import pairwise

import pytest
from balancer_rig import Rig, upright
from hypothesis import given
from hypothesis import strategies as st
from loop_rig import VirtualLoop

from services.balancer import loop as loop_module
from services.balancer.bridge import child
from services.balancer.bridge.link import pack, pack_command, unpack, unpack_command
from services.balancer.core.control.estimation.gyro import Zero
from services.balancer.core.devices import balboa, requests
from services.balancer.device_drivers import Balboa
from swarm.errors import LocalError, PayloadError
from swarm.messages import (
    BalancerFault,
    BalancerState,
    Leds,
    Notice,
    Odometry,
    Parameters,
    SetLeds,
    SetMode,
    SetParameters,
    SetVelocity,
    Stop,
)


def test_ticks_are_on_a_grid(monkeypatch: pytest.MonkeyPatch) -> None:
    loop = VirtualLoop(monkeypatch).run(400)
    assert [at - loop.started[0] for at in loop.started] == pytest.approx([n * 0.01 for n in range(400)], abs=1e-9)
    assert loop.loop.missed == 0


def test_a_stall_is_not_made_up_for(monkeypatch: pytest.MonkeyPatch) -> None:
    loop = VirtualLoop(monkeypatch)
    loop.oversleep = {50: 0.035}
    loop.run(100)
    at = [round((t - loop.started[0]) * 1e3, 3) for t in loop.started]
    assert at[49:53] == [490.0, 535.0, 540.0, 550.0]
    assert loop.loop.missed == 3
    state = loop.bridge.of(BalancerState)[-1]
    assert state.late_max == pytest.approx(0.035)
    assert state.missed == 3


def test_the_last_command_holds_through_a_stall_and_one_step_follows_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """150 ms without a tick: the motors go on as they were, then one step is made with the time that really passed."""
    loop = VirtualLoop(monkeypatch, upright().run(2))
    loop.rig.body.push(0.05)
    loop.run(5)
    commanded: list[tuple[float, tuple[float, float]]] = []
    drive = loop.rig.body.drive
    loop.rig.body.drive = lambda left, right: (commanded.append((loop.rig.now, (left, right))), drive(left, right))
    loop.oversleep = {len(loop.started) + 5: 0.150}
    before = loop.loop.ticks
    loop.run(30)
    times = [at for at, _ in commanded]
    gap = max(range(1, len(times)), key=lambda n: times[n] - times[n - 1])
    assert times[gap] - times[gap - 1] == pytest.approx(0.160, abs=0.005)
    assert commanded[gap - 1][1] != (0.0, 0.0), "nobody set them to zero meanwhile"
    assert loop.loop.ticks - before == 30
    assert len(commanded) == 30, "missed ticks are not replayed"
    assert loop.loop.missed == 15
    assert loop.rig.balancer.mode == "balancing"


def test_a_clock_that_goes_back_is_not_slept_out(monkeypatch: pytest.MonkeyPatch) -> None:
    loop = VirtualLoop(monkeypatch, upright().run(2))
    loop.run(50)
    loop.oversleep = {len(loop.started) + 10: -5.0}
    loop.run(100)
    steps = [b - a for a, b in pairwise(loop.started)]
    assert min(steps) == pytest.approx(-4.99, abs=0.01)
    assert max(steps) < 0.011, "nowhere does it wait for the old time"


def test_measured_time_is_what_the_estimate_is_made_with(monkeypatch: pytest.MonkeyPatch) -> None:
    loop = VirtualLoop(monkeypatch, upright().run(2))
    steps: list[float] = []
    step = loop.rig.balancer.step
    loop.rig.balancer.step = lambda now: (step(now), steps.append(loop.rig.balancer.estimate.dt))
    loop.oversleep = dict.fromkeys(range(10, 20), 0.004)
    loop.run(40)
    assert sum(steps[1:]) == pytest.approx(loop.started[-1] - loop.started[0], abs=1e-9)


def test_faults_and_notices_are_told_once_and_faults_again_each_second(monkeypatch: pytest.MonkeyPatch) -> None:
    loop = VirtualLoop(monkeypatch, upright().run(1))
    loop.run(20)
    assert loop.bridge.of(BalancerFault) == []
    (parameters,) = loop.bridge.of(Parameters)
    assert (parameters.controller, parameters.parameters["max_speed"]) == ("lqr", 0.5)
    loop.bridge.incoming = [
        SetVelocity(9.0, 0.0, 1.0),
        SetParameters({"max_speed": 0.3}),
        SetParameters({"nonsense": 1.0}),
        SetMode("calibrate"),
        SetLeds(True, True, True, 1e9),
    ]
    loop.run(50)
    assert [
        (notice.about, notice.text.split(":")[0]) for notice in loop.bridge.of(Notice) if notice.about != "display"
    ] == [
        ("velocity", "speed 9 is above the limit of 0.5 m/s"),
        ("parameters", "refused"),
        ("mode", "refused"),
        ("leds", "refused"),
    ]
    assert loop.bridge.of(Parameters)[-1].parameters["max_speed"] == 0.3
    loop.bridge.incoming = [Stop(1.0, "r1", "enough")]
    loop.run(10)
    (fault,) = loop.bridge.of(BalancerFault)
    assert (fault.name, fault.reason) == ("stopped", "stopped: enough (by r1)")
    assert "swarm arm" in fault.recovery
    loop.run(300)
    assert len(loop.bridge.of(BalancerFault)) == 1 + 3
    loop.bridge.incoming = [SetMode("rest")]
    loop.run(10)
    assert loop.bridge.of(BalancerFault)[-1].name == ""


def test_a_flood_of_wrong_commands_costs_at_most_a_notice_a_slot(monkeypatch: pytest.MonkeyPatch) -> None:
    loop = VirtualLoop(monkeypatch, upright().run(1))
    loop.bridge.commands = lambda: [(math.inf, SetVelocity(9.0, 0.0, 1.0))] * 8
    loop.run(100)
    assert 20 < len(loop.bridge.of(Notice)) <= 25


def test_an_empty_battery_read_over_the_bus_lays_it_down(monkeypatch: pytest.MonkeyPatch) -> None:
    loop = VirtualLoop(monkeypatch, upright().run(1))
    loop.rig.robot.atmega.battery = 5.8
    loop.run(1500)
    state = loop.bridge.of(BalancerState)[-1]
    assert (state.mode, state.posture, state.battery_level) == ("fault", "front", "empty")
    assert loop.bridge.of(BalancerFault)[-1].name == "battery"
    assert state.battery_left == 0.0


def test_telemetry_is_25_hz_and_odometry_begins_with_the_estimate(monkeypatch: pytest.MonkeyPatch) -> None:
    loop = VirtualLoop(monkeypatch).run(400)
    assert [state.ticks for state in loop.bridge.of(BalancerState)] == list(range(4, 401, 4))
    assert loop.bridge.of(BalancerState)[0].mode == "calibrating"
    assert loop.bridge.of(BalancerState)[-1].mode == "balancing"
    assert loop.bridge.of(BalancerState)[-1].battery == pytest.approx(7.4)
    assert [odometry.sequence for odometry in loop.bridge.of(Odometry)] == list(range(1, 52))
    assert loop.bridge.looks == 4


def test_ready_once_and_progress_each_second(monkeypatch: pytest.MonkeyPatch) -> None:
    loop = VirtualLoop(monkeypatch).run(500)
    assert loop.notified == ["WATCHDOG=1", "WATCHDOG=1", "READY=1", "WATCHDOG=1", "WATCHDOG=1", "WATCHDOG=1"]


def test_a_robot_without_its_board_has_a_service_that_is_up(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its batteries are out, or its firmware is another one: it could get no release otherwise."""
    rig = Rig(start_mode="rest")
    rig.robot.devices.pop(balboa.ADDRESS)
    loop = VirtualLoop(monkeypatch, rig).run(200)
    assert rig.balancer.fault is not None
    assert "READY=1" in loop.notified


def test_a_robot_that_is_carried_for_long_has_a_service_that_is_up(monkeypatch: pytest.MonkeyPatch) -> None:
    rig = Rig(start_mode="rest")
    monkeypatch.setattr(rig.balancer, "_seek_zero", lambda *_: None)
    loop = VirtualLoop(monkeypatch, rig).run(loop_module.STARTED_TICKS - 100)
    assert "READY=1" not in loop.notified
    loop.run(200)
    assert rig.balancer.mode == "calibrating"
    assert loop.notified.count("READY=1") == 1


def test_a_loop_that_is_ten_times_too_slow_is_no_loop_that_hangs(monkeypatch: pytest.MonkeyPatch) -> None:
    """systemd kills it after 3 s without a word."""
    loop = VirtualLoop(monkeypatch)
    loop.oversleep = dict.fromkeys(range(1000), 0.09)
    told: list[float] = []
    monkeypatch.setattr(loop_module, "notify", lambda text, timeout_s: told.append(loop.rig.now))
    loop.run(100)
    assert loop.started[-1] - loop.started[0] > 9.0
    assert max(b - a for a, b in pairwise([loop.started[0], *told, loop.started[-1]])) < 1.5


def test_the_gyros_zero_is_kept_once_a_second(monkeypatch: pytest.MonkeyPatch) -> None:
    loop, kept = VirtualLoop(monkeypatch), list[tuple[Zero, float]]()
    loop.loop._keep = lambda zero, now: kept.append((zero, now))
    loop.run(500)
    assert [zero for zero, _ in kept] == [loop.rig.balancer.gyro_zero] * 4
    assert [round(now - loop.started[0], 1) for _, now in kept] == [2.0, 2.8, 3.8, 4.8]


def test_leds_are_told_on_change_and_once_a_second(monkeypatch: pytest.MonkeyPatch) -> None:
    loop = VirtualLoop(monkeypatch).run(500)
    told = [(leds.red, leds.yellow, leds.green) for leds in loop.bridge.of(Leds)]
    # Two seconds of blinking while it calibrates, four changes each; then on change, and once a second.
    assert told[0] in ((False, True, False), (False, False, False))
    assert told[-1] == (False, False, True)
    told = told[told.index((False, False, True)) :]
    assert told == [(False, False, True)] * 4
    assert [leds.t for leds in loop.bridge.of(Leds)[-3:]] == [loop.bridge.of(Leds)[-1].t] * 3, "written once"


def test_the_loop_obeys_commands_of_the_bridge(monkeypatch: pytest.MonkeyPatch) -> None:
    loop = VirtualLoop(monkeypatch).run(300)
    for message, mode in (
        (SetMode("rest"), "idle"),
        (SetMode("stand"), "standing_up"),
        (SetMode("fly"), "standing_up"),
    ):
        loop.bridge.incoming = [message]
        loop.run(2)
        assert loop.rig.balancer.mode == mode
    loop.bridge.incoming = [SetLeds(True, False, True)]
    loop.run(2)
    assert loop.rig.robot.atmega.leds == (True, False, True)
    loop.bridge.incoming = [Stop(1.0, "", "")]
    loop.run(10)
    state = loop.bridge.of(BalancerState)[-1]
    assert (state.mode, state.fault) == ("fault", "stopped: no reason given (by unknown)")


def test_a_stop_is_obeyed_by_the_motor_command_of_the_same_tick(monkeypatch: pytest.MonkeyPatch) -> None:
    loop = VirtualLoop(monkeypatch, upright().run(1))
    loop.rig.body.push(0.05)
    loop.run(5)
    commanded: list[tuple[int, tuple[float, float]]] = []
    drive = loop.rig.body.drive
    loop.rig.body.drive = lambda left, right: (
        commanded.append((len(loop.started), (left, right))),
        drive(left, right),
    )
    loop.run(2)
    last = len(loop.started)
    assert commanded[-1][1] != (0.0, 0.0)
    loop.bridge.incoming = [*[SetVelocity(0.5, 0.0, 1.0)] * 100, Stop(1.0, "r1", "enough")]
    loop.run(2)
    assert [duties for tick, duties in commanded if tick == last + 1] == [(0.0, 0.0)]
    assert {duties for tick, duties in commanded if tick > last} == {(0.0, 0.0)}


def test_a_command_that_the_bridge_heard_before_a_stop_moves_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    loop = VirtualLoop(monkeypatch, upright().run(1))
    loop.run(1)
    loop.bridge.heard = loop.rig.now
    loop.bridge.incoming = [
        SetMode("stand"),
        SetVelocity(0.1, 0.0, 1.0),
        SetLeds(True, True, True, 9.0),
        Stop(1.0, "r1", ""),
    ]
    loop.run(10)
    assert loop.rig.balancer.mode == "fault"
    assert ["void" in notice.text for notice in loop.bridge.of(Notice)] == [True, True]
    loop.bridge.incoming = [SetMode("rest")]
    loop.run(2)
    assert loop.rig.balancer.mode == "idle", "a command that only stops is never void"
    loop.bridge.heard = loop.rig.now
    loop.bridge.incoming = [SetMode("stand")]
    loop.run(2)
    assert loop.rig.balancer.mode == "standing_up"


def test_a_command_from_before_a_stop_moves_nothing_where_the_tick_stood_still_before_it_looked(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    loop = VirtualLoop(monkeypatch, upright().run(1))
    loop.run(1)
    look = loop.bridge.stop

    def look_late() -> Stop | None:
        """Commands, then a stop, come while the tick has begun and stands still."""
        loop.bridge.stop = look
        loop.rig.now += 0.5
        loop.bridge.heard = loop.rig.now - 0.1
        loop.bridge.incoming = [SetMode("stand"), SetVelocity(0.1, 0.0, 1.0), Stop(1.0, "r1", "")]
        return look()

    loop.bridge.stop = look_late
    loop.run(10)
    assert loop.rig.balancer.mode == "fault"
    assert ["void" in notice.text for notice in loop.bridge.of(Notice)] == [True, True]


def test_what_only_the_loop_says_is_no_command(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    loop = VirtualLoop(monkeypatch)
    loop.bridge.incoming = [Odometry(1.0, 1, *[0.0] * 8)]
    loop.run(2)
    assert "the bridge sent a Odometry" in caplog.text


@given(st.binary(max_size=80))
def test_any_datagram_is_a_message_or_refused(data: bytes) -> None:
    try:
        message = unpack(data)
    except PayloadError:
        return
    assert unpack(pack(message)) == message


@given(st.binary(max_size=80))
def test_any_datagram_of_the_bridge_is_a_command_or_refused(data: bytes) -> None:
    try:
        heard, message = unpack_command(data)
    except PayloadError:
        return
    again = unpack_command(pack_command(heard, message))
    assert again[1] == message
    assert again[0] == heard or math.isnan(heard)


def test_a_stop_is_kept_at_once_for_the_process_after_this_one(monkeypatch: pytest.MonkeyPatch) -> None:
    loop = VirtualLoop(monkeypatch, upright().run(1))
    kept: list[bool] = []
    loop.loop._keep_stopped = kept.append
    loop.run(20)
    loop.bridge.incoming = [Stop(1.0, "r1", "enough")]
    loop.run(2)
    assert kept == [True]
    loop.run(150)
    loop.bridge.incoming = [SetMode("stand")]
    loop.run(150)
    assert kept == [True, False]


def test_a_stop_that_could_not_be_kept_is_kept_when_there_is_room(monkeypatch: pytest.MonkeyPatch) -> None:
    loop = VirtualLoop(monkeypatch, upright().run(1))
    kept: list[bool] = []

    def full(_: bool) -> None:
        assert loop.loop._balancer.fault is not None, "the motors are stopped before"
        raise OSError(errno.ENOSPC, "No space left on device")

    loop.loop._keep_stopped = full
    loop.bridge.incoming = [Stop(1.0, "r1", "enough")]
    loop.run(2)
    loop.loop._keep_stopped = kept.append
    loop.run(150)
    assert kept == [True]


def test_no_parameters_end_the_loop_or_the_bridge() -> None:
    """Those that an app names come back in a notice, which has to fit into a message."""
    for values in ({"a" * 65_000: 1.0}, {str(number): 1.0 for number in range(10_000)}):
        with pytest.raises(LocalError, match="parameters: expected at most 32"):
            requests.check(SetParameters(values))
    rig = upright()
    rig.balancer.notice("parameters", "x" * 65_000)
    pack(Notice(0.0, *rig.balancer.notices[-1]))


def test_a_bridge_that_cannot_be_started_is_tried_again(monkeypatch: pytest.MonkeyPatch) -> None:
    def fails() -> int:
        raise OSError(errno.EAGAIN, "Resource temporarily unavailable")

    bridge = child.Bridge.__new__(child.Bridge)
    monkeypatch.setattr(child.Bridge, "_start", lambda self, now, stopped=False: None)
    bridge.__init__(0.0)
    monkeypatch.undo()
    monkeypatch.setattr(os, "fork", fails)
    bridge.keep_up(2.0)
    bridge.keep_up(4.0)
    assert (bridge.pid, bridge._socket, bridge._stops) == (0, None, None)


def test_an_i2c_bus_that_times_out_leaves_no_memory_behind() -> None:
    """The loop's process collects no circles."""

    class Silent:
        def write(self, address: int, data: bytes) -> None:
            raise OSError(errno.ETIMEDOUT, "Connection timed out")

    driver = Balboa(Silent(), lambda: 0.0, lambda _: None)  # type: ignore[arg-type]
    gc.collect()
    gc.disable()
    try:
        for _ in range(10):
            with contextlib.suppress(OSError):
                driver.select(8)
        assert gc.collect() == 0
    finally:
        gc.enable()
