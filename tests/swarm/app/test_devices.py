"""An app's hand on its robot: what it looks at, what it takes, and how it gives it back."""

from collections.abc import Callable, Iterable
from typing import Any

import pytest

from swarm.app.devices import (
    BATTERY_LOST,
    DRIVE_CLAIM,
    DRIVE_REPEAT,
    LED_CLAIM,
    LED_REPEAT,
    MOST_PRESSES,
    POSE_LOST,
    SILENT,
    Devices,
    PoseView,
)
from swarm.errors import AppError
from swarm.messages import BalancerState, Battery, Buttons, Pose, SetDisplay, SetLeds, SetMode, SetVelocity
from swarm.messages.balancer import LONGEST_AHEAD_S
from swarm.messages.codec import encode


class FakeBus:
    """Keeps what is published, and hands on what the test lets come."""

    def __init__(self) -> None:
        self.published: list[Any] = []
        self.callbacks: dict[str, Callable[[str, bytes], None]] = {}

    def publish(self, key: str, message: object, *, urgent: bool = False) -> None:
        assert key.startswith("swarm/r0/balancer/set/")
        self.published.append(message)

    def subscribe(self, keys: str | Iterable[str], callback: Callable[[str, bytes], None]) -> None:
        self.callbacks[str(keys)] = callback

    def come(self, topic: str, message: object) -> None:
        self.callbacks[f"swarm/r0/{topic}"](topic, encode(message))

    def take(self) -> list[Any]:
        found, self.published = self.published, []
        return found


class Rig:
    def __init__(self) -> None:
        self.now = 100.0
        self.bus = FakeBus()
        self.devices = Devices(self.bus, "r0", lambda: self.now)  # type: ignore[arg-type]

    def after(self, seconds: float) -> list[Any]:
        """What is commanded by then, with the timers that come."""
        end = self.now + seconds
        while (due := self.devices.next_deadline()) is not None and due <= end:
            self.now = max(self.now, due)
            self.devices.handle_timer()
        self.now = end
        return self.bus.take()


def test_the_robot_of_an_app_that_makes_no_steps_stands_still_until_the_next_one(rig: Rig) -> None:
    rig.devices.drive(0.2, 0.5)
    assert rig.bus.take() == [SetVelocity(0.2, 0.5, DRIVE_CLAIM)]
    still, goes = [SetVelocity(0.0, 0.0, DRIVE_CLAIM)], [SetVelocity(0.2, 0.5, DRIVE_CLAIM)]
    for idle, told in ((True, still), (True, []), (True, []), (False, goes), (True, still)):
        rig.now += DRIVE_REPEAT
        rig.devices.handle_timer(idle=idle)
        assert rig.bus.take() == told


@pytest.fixture
def rig() -> Rig:
    return Rig()


def state(mode: str, posture: str = "front", fault: str = "") -> BalancerState:
    return BalancerState(0, mode, 0, 0, 0, 0, 0, None, 0, 0, 0, fault, posture=posture)


def test_nothing_is_subscribed_to_before_somebody_looks(rig: Rig) -> None:
    assert rig.bus.callbacks == {}
    assert rig.devices.pose is None
    assert list(rig.bus.callbacks) == ["swarm/r0/dwm/pose"]


def test_pose_with_its_age_until_it_is_lost(rig: Rig) -> None:
    assert rig.devices.pose is None
    rig.bus.come("dwm/pose", Pose(99.9, 1, 1.0, 2.0, 0.5, 90, "ekf", 0.02, 0.03, 0.0, 0.1))
    assert rig.devices.pose == PoseView(1.0, 2.0, 0.5, 0.02, 0.03, 0.1, pytest.approx(0.1))
    rig.now += POSE_LOST
    assert rig.devices.pose is None
    rig.bus.come("dwm/pose", Pose(rig.now, 2, 1.0, 2.0, None, 0, "ekf"))
    assert rig.devices.pose is None  # no fix


@pytest.mark.parametrize(
    ("mode", "tilt", "posture"),
    [
        ("balancing", "upright", "standing"),
        ("standing_up", "front", "standing_up"),
        ("lying_down", "upright", "lying_down"),
        ("idle", "back", "back"),
        ("fault", "front", "front"),
        ("idle", "upright", "upright"),
    ],
)
def test_an_app_sees_the_posture_of_its_robot(rig: Rig, mode: str, tilt: str, posture: str) -> None:
    assert rig.devices.posture == "unknown"
    rig.bus.come("balancer/state", state(mode, tilt, "it fell" if mode == "fault" else ""))
    assert rig.devices.posture == posture
    assert rig.devices.fault == ("it fell" if mode == "fault" else "")
    rig.now += SILENT + 0.1
    assert rig.devices.posture == "unknown"


def test_an_unreadable_message_leaves_the_battery_as_it_was(rig: Rig) -> None:
    assert rig.devices.battery is None
    rig.bus.come("balancer/battery", Battery(0.0, 7.2))
    rig.bus.callbacks["swarm/r0/balancer/battery"]("x", b"rubbish")
    assert rig.devices.battery == 7.2
    rig.now += BATTERY_LOST + 0.1
    assert rig.devices.battery is None


def test_presses_are_counted_held_buttons_are_seen(rig: Rig) -> None:
    presses: list[str] = []
    rig.devices.on_button(presses.append)
    rig.bus.come("balancer/buttons", Buttons(0, False, False, False, 3, 0, 1))
    assert presses == []  # before the app came
    rig.bus.come("balancer/buttons", Buttons(0, True, False, True, 4, 0, 1))
    assert presses == ["a"]
    assert rig.devices.buttons == ("a", "c")
    rig.bus.come("balancer/buttons", Buttons(0, False, False, False, 6, 1, 1))  # two messages were lost
    assert presses == ["a", "a", "a", "b"]
    rig.bus.come("balancer/buttons", Buttons(0, False, False, True, 0, 0, 1))  # the balancer was started anew
    assert presses == ["a", "a", "a", "b", "c"]
    rig.bus.come("balancer/buttons", Buttons(0, False, False, True, 2**62, 0, 1))
    assert len(presses) == 5 + MOST_PRESSES


def test_leds_are_claimed_again_and_what_is_left_out_stays(rig: Rig) -> None:
    rig.devices.leds(None, None, True, None)
    rig.devices.leds(True, None, None, None)
    green, both = SetLeds(False, False, True, LED_CLAIM), SetLeds(True, False, True, LED_CLAIM)
    assert rig.bus.take() == [green, both]
    rig.devices.leds(True, None, None, None)  # they are so
    assert rig.bus.take() == []
    assert rig.after(2.5 * LED_REPEAT) == [both, both]


def test_leds_at_a_time_are_not_voided_by_the_claim(rig: Rig) -> None:
    """An order at once would void those for later times: the claim is renewed after the last of them."""
    rig.devices.leds(True, None, None, rig.now + 2.0)
    rig.devices.leds(False, None, None, rig.now + 2.5)
    assert [message.at for message in rig.bus.take()] == [102.0, 102.5]
    assert rig.after(2.5 + LED_REPEAT - 0.1) == []
    assert rig.after(0.2) == [SetLeds(False, False, False, LED_CLAIM)]
    for at in (
        float("nan"),
        rig.now + LONGEST_AHEAD_S + 0.1,
    ):  # the balancer would refuse it, and the app not hear of it
        with pytest.raises(AppError, match=r"robot\.leds: at: expected a time .* at most 10 s ahead, got"):
            rig.devices.leds(True, None, None, at)


def test_an_led_is_on_or_off(rig: Rig) -> None:
    with pytest.raises(AppError, match=r"robot\.leds: green: expected True or False, got 'off'"):
        rig.devices.leds(None, None, "off", None)  # type: ignore[arg-type]


def test_drive_goes_on_until_told_otherwise(rig: Rig) -> None:
    rig.devices.drive(0.1, 0.5)
    go = SetVelocity(0.1, 0.5, DRIVE_CLAIM)
    assert rig.after(2.5 * DRIVE_REPEAT) == [go, go, go]
    assert DRIVE_REPEAT < DRIVE_CLAIM / 2  # one may be lost
    rig.devices.drive(0.0, 0.0)
    assert rig.after(10.0) == [SetVelocity(0.0, 0.0, DRIVE_CLAIM)]
    with pytest.raises(AppError, match=r"robot\.drive\(nan, 0\.0\): expected finite numbers"):
        rig.devices.drive(float("nan"), 0.0)


def test_the_display_shows_an_apps_lines_until_they_are_empty(rig: Rig) -> None:
    rig.devices.display(["hello", 3])
    assert rig.after(1.5 * LED_REPEAT) == [SetDisplay("hello\n3", LED_CLAIM)] * 2
    rig.devices.display([])
    assert rig.after(10.0) == [SetDisplay("", LED_CLAIM)]
    rig.devices.display(["x" * 500])
    assert len(rig.bus.take()[0].text) == 200


def test_an_app_commands_the_balancers_mode_once(rig: Rig) -> None:
    rig.devices.mode("stand")
    assert rig.bus.take() == [SetMode("stand")]
    assert rig.devices.next_deadline() is None


def test_all_is_given_back_and_only_what_was_taken(rig: Rig) -> None:
    rig.devices.release()
    assert rig.bus.take() == []
    rig.devices.leds(True, None, None, None)
    rig.devices.drive(0.1, 0.0)
    rig.devices.display(["x"])
    rig.bus.take()
    rig.devices.release()
    velocity, leds, display = rig.bus.take()
    assert (velocity.speed, velocity.turn_rate) == (0.0, 0.0)
    assert leds.seconds < 0.1
    assert display.text == ""
    assert rig.after(100.0) == []
