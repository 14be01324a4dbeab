"""LED orders with a time: which holds when, and how near to its time it is written."""

import math
from itertools import pairwise

import pytest
from balancer_rig import upright
from hypothesis import given
from hypothesis import strategies as st
from loop_rig import VirtualLoop

from services.balancer.core.devices.leds import (
    CONTROL_S,
    MARGIN_S,
    MOST_AHEAD,
    WRITE_S,
    LedClaim,
    LedOrder,
    moment,
)
from swarm.errors import LocalError
from swarm.messages import Leds, Notice, SetLeds, SetMode
from swarm.messages.balancer import LONGEST_AHEAD_S

YELLOW, GREEN, OFF = (False, True, False), (False, False, True), (False, False, False)


def test_orders_hold_from_their_time_until_the_next_one_or_their_end() -> None:
    claim = LedClaim()
    for at, leds in ((1.0, YELLOW), (2.0, OFF), (3.0, GREEN)):
        assert claim.take(LedOrder(leds, at, at + 1.5), 0.0)
    assert [claim.leds(t) for t in (0.5, 1.0, 1.9, 2.0, 3.0, 4.4, 4.5)] == [
        None,
        YELLOW,
        YELLOW,
        OFF,
        GREEN,
        GREEN,
        None,
    ]


def test_a_new_order_voids_what_was_said_of_its_time_and_later() -> None:
    claim = LedClaim()
    for at, leds in ((1.0, YELLOW), (2.0, OFF), (3.0, YELLOW)):
        claim.take(LedOrder(leds, at, at + 9.0), 0.0)
    claim.take(LedOrder(GREEN, 1.5, 9.0), 0.5)
    assert [claim.leds(t) for t in (1.2, 1.5, 2.5, 3.5)] == [YELLOW, GREEN, GREEN, GREEN]
    claim.take(LedOrder(YELLOW, 4.0, 9.0), 3.6)
    claim.take(LedOrder(OFF, 3.7, 9.0), 3.7)
    assert claim.leds(5.0) == OFF


def test_one_written_a_little_early_stays() -> None:
    """The loop may write it up to the length of a control step before its time, and look again before that."""
    claim = LedClaim()
    claim.take(LedOrder(YELLOW, 0.0, 9.0), 0.0)
    claim.take(LedOrder(GREEN, 1.001, 9.0), 0.0)
    assert claim.leds(1.001) == GREEN
    assert claim.leds(1.0) == GREEN


def test_too_many_are_refused_and_the_others_stay() -> None:
    claim = LedClaim()
    assert all(claim.take(LedOrder(YELLOW, 1.0 + n, 99.0), 0.0) for n in range(MOST_AHEAD))
    assert not claim.take(LedOrder(GREEN, 99.0, 100.0), 0.0)
    assert claim.take(LedOrder(GREEN, 5.0, 9.0), 0.0), "room, since it voids the later ones"
    assert claim.leds(4.5) == YELLOW
    assert claim.next_change == 5.0


@given(st.floats(-0.02, 0.1))
def test_the_moment_is_the_nearest_that_leaves_the_control_step_alone(ahead: float) -> None:
    """Ticks at 0, 10 ms, ...; a slack begins when the control step is over."""
    at = 0.05 + ahead
    for tick in range(20):
        until = (tick + 1) * 0.01
        begin = tick * 0.01 + CONTROL_S
        write = moment(at, until)
        if write is None:
            continue
        write = max(write, begin)
        assert write + WRITE_S <= until - MARGIN_S + 1e-9
        if at >= 0.01:  # not one that came too late
            assert abs(write + WRITE_S - at) <= (CONTROL_S + MARGIN_S + 2 * WRITE_S) / 2 + 1e-9
        return
    assert math.isclose(at, 0.2)


def test_the_loop_writes_them_on_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """Blinking at 7 Hz, ordered half a second ahead: at the registers each change within 3 ms of its time."""
    loop = VirtualLoop(monkeypatch, upright().run(1))
    robot = loop.rig.robot
    loop.run(5)
    robot.atmega.led_changes.clear()
    start = loop.rig.now + 0.5
    due = [start + n / 14 for n in range(28)]
    loop.bridge.incoming = [SetLeds(*(YELLOW if n % 2 == 0 else OFF), 1.0, at) for n, at in enumerate(due)]
    loop.run(300)
    changes = [(t, leds) for t, leds in robot.atmega.led_changes if leds != GREEN]
    assert [leds for _, leds in changes] == [YELLOW, OFF] * 14
    errors = [t - at for (t, _), at in zip(changes, due, strict=True)]
    assert max(map(abs, errors)) < 3e-3
    assert sorted(map(abs, errors))[14] < 0.8e-3
    assert loop.loop.missed == 0
    assert [b - a for a, b in pairwise(loop.started[5:])] == pytest.approx([0.01] * 299, abs=1e-6)
    told = [leds for leds in loop.bridge.of(Leds) if (leds.red, leds.yellow, leds.green) == YELLOW]
    assert [leds.t for leds in told][:3] == pytest.approx([t for t, leds in changes if leds == YELLOW][:3], abs=1e-3)


def test_a_mode_command_ends_those_that_wait(monkeypatch: pytest.MonkeyPatch) -> None:
    loop = VirtualLoop(monkeypatch, upright().run(1))
    loop.bridge.incoming = [SetLeds(*YELLOW, 1.0, loop.rig.now + 0.3)]
    loop.run(2)
    loop.bridge.incoming = [SetMode("stand")]
    loop.run(100)
    assert loop.rig.robot.atmega.leds == GREEN


def test_a_time_too_far_ahead_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    rig = upright().run(1)
    with pytest.raises(LocalError, match="at: expected at most 10 s from now on, got 11"):
        rig.balancer.claim_leds(YELLOW, 1.0, rig.now, rig.now + LONGEST_AHEAD_S + 1.0)
    loop = VirtualLoop(monkeypatch, rig)
    loop.bridge.incoming = [SetLeds(*YELLOW, 1.0, rig.now + 1.0 + n / 10) for n in range(MOST_AHEAD + 1)]
    loop.run(8)
    assert ["orders wait" in notice.text for notice in loop.bridge.of(Notice)] == [True]
