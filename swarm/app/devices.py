"""The robot's own devices for an app, over the bus keys of balancer and dwm: pose, posture, buttons, LEDs, drive.

What an app took it gives back: LEDs, display and drive are claimed for moments only, and claimed again by
`handle_timer` for as long as the app works. When it stops (`release`), hangs or dies, the robot stands still and shows
its own state again. Nothing is subscribed to before the app first looks at it.
"""

import logging
import math
import threading
from collections.abc import Callable, Iterable
from functools import partial
from typing import TypeVar

from swarm import clock
from swarm.bus.protocol import BusLike, Now
from swarm.errors import AppError
from swarm.frozen import frozen
from swarm.messages import (
    BalancerState,
    Battery,
    Buttons,
    Pose,
    SetDisplay,
    SetLeds,
    SetMode,
    SetVelocity,
)
from swarm.messages.balancer import LONGEST_AHEAD_S
from swarm.messages.codec import decoded
from swarm.messages.keys import key

LED_CLAIM, LED_REPEAT = 3.0, 1.0
"""Seconds for which LEDs and display are claimed, and after which they are claimed again."""
DRIVE_CLAIM, DRIVE_REPEAT = 0.5, 0.2
"""Seconds between commands to drive. A robot whose app has died stops within half a second."""
MOST_PRESSES = 100
"""The most presses of a button that an app is told of after one message."""
SILENT = 2.0
"""Seconds without a message of the balancer after which the robot's posture counts as unknown."""
BATTERY_LOST = 60.0
"""Seconds without a reading after which the battery's voltage counts as unknown, as for the balancer."""
POSE_LOST = 5.0
"""Seconds after which a pose is too old to be used."""

MAX_TEXT = 200
"""The most letters of a text that the balancer accepts for the display, which shows fewer."""

BUTTONS = ("a", "b", "c")
MODES = {"balancing": "standing", "standing_up": "standing_up", "lying_down": "lying_down"}
"""The posture of a robot in these modes of the balancer. In the other modes it follows from the tilt."""

M = TypeVar("M")
_log = logging.getLogger("devices")


@frozen
class PoseView:
    """The pose of a robot by its UWB module (docs/reference/robot/uwb-module.md), in the frame of the anchors."""

    x: float
    """Place in the anchors' frame, m."""
    y: float
    heading: float | None
    """rad, counter-clockwise from x; None where the filter does not estimate it."""
    sigma_x: float | None
    """Standard deviation, m; None where the filter does not estimate it."""
    sigma_y: float | None
    sigma_heading: float | None
    """Standard deviation, rad."""
    age: float
    """Age of the pose, s."""


class Devices:
    """One app's view of its robot."""

    def __init__(self, bus: BusLike, robot: str, now: Now = clock.now) -> None:
        """`now` is the clock of this robot's processes."""
        self._bus = bus
        self._robot = robot
        self._now = now
        self._lock = threading.Lock()
        self._watched: set[str] = set()
        self._pose: Pose | None = None
        self._state: BalancerState | None = None
        self._state_came = -math.inf
        self._battery: float | None = None
        self._battery_came = -math.inf
        self._held: tuple[str, ...] = ()
        self._presses: tuple[int, ...] | None = None
        self._on_button: Callable[[str], None] | None = None
        self._leds: tuple[bool, bool, bool] | None = None
        self._leds_from = -math.inf
        self._text: str | None = None
        self._velocity: tuple[float, float] | None = None
        self._idle = False
        self._leds_at = self._display_at = self._drive_at = math.inf
        self.on_claim: Callable[[], None] | None = None
        """Called when `next_deadline` may have changed, on the thread that made a claim."""

    # -- looking

    @property
    def pose(self) -> PoseView | None:
        """Return the robot's pose; None while it is unknown, or older than `POSE_LOST`."""
        self._watch("pose", "dwm", Pose, self._take_pose)
        pose, now = self._pose, self._now()
        if pose is None or pose.quality == 0 or now - pose.t > POSE_LOST:
            return None
        sigmas = (pose.deviation_x, pose.deviation_y, pose.deviation_heading)
        return PoseView(pose.x, pose.y, pose.heading, *sigmas, max(0.0, now - pose.t))

    @property
    def posture(self) -> str:
        """standing, standing_up, lying_down, front or back (it lies on it), upright (held), leaning or unknown."""
        state = self._balancer()
        return "unknown" if state is None else MODES.get(state.mode, state.posture)

    @property
    def fault(self) -> str:
        """Why the balancer keeps the motors off; empty where it does not."""
        state = self._balancer()
        return "" if state is None else state.fault

    @property
    def battery(self) -> float | None:
        """V; None before it was read, and where it was not read for `BATTERY_LOST`."""
        self._watch("battery", "balancer", Battery, self._take_battery)
        return self._battery if self._now() - self._battery_came <= BATTERY_LOST else None

    @property
    def buttons(self) -> tuple[str, ...]:
        """Return the buttons that are held now, of "a", "b" and "c"."""
        self._watch("buttons", "balancer", Buttons, self._take_buttons)
        return self._held

    def on_button(self, callback: Callable[[str], None]) -> None:
        """Call `callback(button)` on the bus's thread for each press, those whose message was lost included."""
        self._on_button = callback
        self._watch("buttons", "balancer", Buttons, self._take_buttons)

    def asked(self, topic: str) -> bool:
        """Return whether the app has looked at `pose`, `state`, `battery` or `buttons`."""
        return topic in self._watched

    # -- acting

    def leds(self, red: bool | None, yellow: bool | None, green: bool | None, at: float | None) -> None:
        """Switch LEDs at once, or from a time of the robot's clock on; None leaves one as it was (off at first).
        What was ordered for that time and later is void."""
        for name, wish in (("red", red), ("yellow", yellow), ("green", green)):
            if wish is not None and wish not in (False, True):
                raise AppError(f"robot.leds: {name}: expected True or False, got {wish!r}")
        now = self._now()
        if at is not None and not (math.isfinite(at) and at <= now + LONGEST_AHEAD_S):
            until = f"at most {LONGEST_AHEAD_S:g} s ahead"
            raise AppError(f"robot.leds: at: expected a time of robot.now or later, {until}, got {at!r}")
        with self._lock:
            had = self._leds or (False, False, False)
            wanted = [old if new is None else bool(new) for old, new in zip(had, (red, yellow, green), strict=True)]
            leds = (wanted[0], wanted[1], wanted[2])
            if at is None and leds == self._leds and self._leds_from <= now < self._leds_at:
                return  # they are so, and claimed
            self._leds, self._leds_from = leds, now if at is None else max(now, at)
            self._command("leds", SetLeds(*leds, LED_CLAIM, at))
            # Claimed again when the last order's time has come: that would void the orders for later times.
            self._leds_at = self._leds_from + LED_REPEAT
        self._claimed()

    def display(self, lines: Iterable[object]) -> None:
        """Show text; none shows the app's values again."""
        text = "\n".join(map(str, lines))[:MAX_TEXT]
        with self._lock:
            if text == self._text:
                return
            self._text, self._display_at = text, self._now()
        self.handle_timer()
        self._claimed()

    def drive(self, speed: float, turn: float) -> None:
        """Go on with this speed (m/s, forward) and turn rate (rad/s, left) until told otherwise."""
        if not (math.isfinite(speed) and math.isfinite(turn)):
            raise AppError(f"robot.drive({speed!r}, {turn!r}): expected finite numbers, in m/s and rad/s")
        velocity = (float(speed), float(turn))
        with self._lock:
            if velocity == self._velocity:
                return  # it is claimed again and again
            self._velocity, self._drive_at = velocity, self._now()
        self.handle_timer()
        self._claimed()

    def mode(self, mode: str) -> None:
        """Command the mode `stand` or `lie`."""
        self._command("mode", SetMode(mode))

    # -- time

    def next_deadline(self) -> float | None:
        """Return the time at which the host must call `handle_timer`; None while no timer runs."""
        due = min(self._leds_at, self._display_at, self._drive_at)
        return None if due == math.inf else due

    def handle_timer(self, *, idle: bool = False) -> None:
        """Claim what the app has, where that is due. An app that is `idle` makes no steps: its robot is told once to
        stand still, and then others may drive it until the next step."""
        now = self._now()
        with self._lock:
            if now >= self._leds_at and self._leds is not None:
                self._command("leds", SetLeds(*self._leds, LED_CLAIM))
                self._leds_at = now + LED_REPEAT
            if now >= self._display_at and self._text is not None:
                self._command("display", SetDisplay(self._text, LED_CLAIM))
                self._text, self._display_at = (self._text, now + LED_REPEAT) if self._text else (None, math.inf)
            if now >= self._drive_at and self._velocity is not None:
                if not (idle and self._idle):
                    self._command("velocity", SetVelocity(*((0.0, 0.0) if idle else self._velocity), DRIVE_CLAIM))
                self._idle = idle
                at_rest = self._velocity == (0.0, 0.0)
                self._velocity, self._drive_at = (None, math.inf) if at_rest else (self._velocity, now + DRIVE_REPEAT)

    def release(self) -> None:
        """Give back LEDs, display and drive."""
        with self._lock:
            if self._velocity is not None:
                self._command("velocity", SetVelocity(0.0, 0.0, DRIVE_CLAIM))
            if self._leds is not None:
                self._command("leds", SetLeds(*self._leds, 0.01))
            if self._text is not None:
                self._command("display", SetDisplay(""))
            self._leds = self._text = self._velocity = None
            self._leds_at = self._display_at = self._drive_at = math.inf

    # -- inside

    def _claimed(self) -> None:
        if self.on_claim is not None:
            self.on_claim()

    def _command(self, what: str, message: object) -> None:
        self._bus.publish(key(self._robot, "balancer", "set", what), message, urgent=True)

    def _balancer(self) -> BalancerState | None:
        self._watch("state", "balancer", BalancerState, self._take_state)
        return self._state if self._now() - self._state_came <= SILENT else None

    def _watch(self, topic: str, service: str, kind: type[M], take: Callable[[M], None]) -> None:
        if topic in self._watched:
            return
        self._watched.add(topic)
        self._bus.subscribe(key(self._robot, service, topic), decoded(kind, take, partial(_log.debug, "%s")))

    def _take_pose(self, pose: Pose) -> None:
        self._pose = pose

    def _take_state(self, state: BalancerState) -> None:
        self._state, self._state_came = state, self._now()

    def _take_battery(self, battery: Battery) -> None:
        self._battery, self._battery_came = battery.voltage, self._now()

    def _take_buttons(self, buttons: Buttons) -> None:
        held = (buttons.a, buttons.b, buttons.c)
        self._held = tuple(name for name, down in zip(BUTTONS, held, strict=True) if down)
        presses = buttons.presses
        # What was pressed before the app came is not for it; a balancer that was started anew counts from 0.
        before, self._presses = self._presses, presses
        if before is None or self._on_button is None:
            return
        if any(new < old for old, new in zip(before, presses, strict=True)):
            before = (0, 0, 0)
        for name, old, new in zip(BUTTONS, before, presses, strict=True):
            for _ in range(min(new - old, MOST_PRESSES)):
                self._on_button(name)
