"""The robot that an app runs on: `self.robot`. It is the same on real robots and in both simulations.

The app host fills it: graph and random numbers always, the rest (`overlays`, `mesh_clock`, `ranging`, `devices`,
`bus`...) if the app runs on a bus. An app that uses a part that is missing gets an `AppError`.
"""

import logging
import math
import random
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from swarm import clock
from swarm.config.types import Anchor
from swarm.core.graph import Graph
from swarm.errors import AppError, LocalError
from swarm.messages import AppOutput, Flooded, Measurement, Range, Sent
from swarm.messages.codec import Value, as_value
from swarm.messages.keys import is_key, key

if TYPE_CHECKING:  # brings the bus along, which a step in virtual time does without
    from swarm.app.devices import Devices, PoseView
    from swarm.app.mesh_clock import MeshClock
    from swarm.app.overlays import Handle, Message, Overlays
    from swarm.app.ranging import Ranging
    from swarm.app.truth import RobotTruth
    from swarm.bus.protocol import BusLike

KEY_PART = "expected letters, digits and _ . : -"
NEEDS_BUS = "needs a bus: an app has one when it runs on a robot, real or simulated"


@dataclass
class Robot:
    """The robot that an app runs on, as the app sees it.

    Values of sensors and clocks differ in each run. A `SyncApp` that puts them into its state loses the promise that
    runs are equal to the bit; it may use them in what it publishes or does.
    """

    name: str
    """Name of this robot."""
    graph: Graph
    """The topology of the whole swarm."""
    anchors: tuple[Anchor, ...] = ()
    """UWB modules at known places, m."""
    seed: int = 0
    """The number from which the swarm's random numbers are drawn."""
    log: logging.Logger = field(default_factory=lambda: logging.getLogger("app"))
    """The app's logger: `swarm logs` and recordings show what it logs."""
    weights: Mapping[str, float] = field(default_factory=dict)
    """Consensus weight w_ij of each neighbour, by name."""
    own_weight: float = 1.0
    """Consensus weight w_ii of this robot; the sum of all weights is 1."""
    app: str = "app"
    """Name of the app on the bus."""
    time: Callable[[], float] = clock.now
    """The host's clock."""
    bus: "BusLike | None" = None
    """The robot's bus; None if the app does not run on a robot."""
    overlays: "Overlays | None" = None
    """Messages to the whole swarm or to one robot; None without a bus."""
    mesh_clock: "MeshClock | None" = None
    """The swarm's common time; None without a bus."""
    ranging: "Ranging | None" = None
    """Distances by UWB; None without a bus."""
    devices: "Devices | None" = None
    """The robot's own devices; None without a bus."""
    timers: Callable[[float, str], None] | None = None
    """The function that `after` calls; the host of an event-driven app sets it."""
    recording: Callable[[str, float, Value], None] | None = None
    """The function that `record` calls with name, time (s) and value; the host of a recorded run sets it."""

    said: Callable[[str, str], None] | None = None
    """The function that takes level and text of what the app prints or logs; the host sets it."""
    truth: "Callable[[], RobotTruth | None] | None" = None
    """The function that returns what a simulation knows, for an app that measures its `error`; None on real robots."""

    def __post_init__(self) -> None:
        self._measurement: Measurement | None = None
        self._label = "start"
        self._stepped: tuple[int, float] | None = None
        self.dt = 0.0
        """Seconds between the beginning of the step before and of this one, by the host's clock; 0 in the first step of
        a process. Links and restarts change it, and with it the trajectory of an app that uses it."""
        self._random: random.Random | None = None

    # -- the swarm

    @property
    def neighbours(self) -> tuple[str, ...]:
        """Names of the robots linked to this one, sorted."""
        return self.graph.neighbours(self.name)

    @property
    def swarm(self) -> tuple[str, ...]:
        """Names of all robots, in the order of swarm.toml."""
        return self.graph.names

    @property
    def random(self) -> random.Random:
        """Return a generator of random numbers. Seed, robot and iteration set it, so a repeated step gets the same
        numbers."""
        if self._random is None:
            self._random = random.Random(f"{self.seed}/{self.name}/{self._label}")
        return self._random

    # -- time

    @property
    def now(self) -> float:
        """Time of the robot's monotonic clock, s; virtual in virtual time. Use it to measure how long something takes.
        Different robots have different times: `clock` has a common one. Keep it out of the state of a SyncApp."""
        return self.time()

    @property
    def clock(self) -> "MeshClock":
        """The swarm's common time: `now()` (s), `error` (s) and `root` (a robot's name). They are None until the mesh
        has measured them. Keep it out of the state of a SyncApp. Raises `AppError` without a bus."""
        if self.mesh_clock is None:
            raise AppError(f"robot.clock {NEEDS_BUS}")
        return self.mesh_clock

    def after(self, seconds: float, name: str) -> None:
        """Call the app's `on_timer(name)` after `seconds`. A second call with the same name replaces the first one.

        For event-driven and periodic apps. Raises `AppError` in a SyncApp, or for a time that is negative or not
        finite."""
        if self.timers is None:
            raise AppError("robot.after: a SyncApp has no timers; EventApp and PeriodicApp do")
        if not (math.isfinite(seconds) and seconds >= 0.0):
            raise AppError(f"robot.after({seconds!r}, {name!r}): expected a time of at least 0 s")
        self.timers(seconds, name)

    # -- UWB

    @property
    def measurement(self) -> Measurement:
        """The measurement for this step: `distance` to the target and own place `x`, `y`, all in m.

        Raises `AppError` if the class does not declare `measured = True`."""
        if self._measurement is None:
            raise AppError("no measurement: write `measured = True` into the app class to get one before each step")
        return self._measurement

    @property
    def ranges(self) -> tuple[Range, ...]:
        """The newest UWB ranges to anchors, and to robots whose module is an anchor; none is older than 1 s. Keep them
        out of the state of a SyncApp. Raises `AppError` without a bus."""
        return self._ranging().ranges

    def distance(self, robot: str) -> float | None:
        """Return the measured distance to the robot `robot`, m; None if neither robot has measured it within the last
        second.

        One of the two modules must be an anchor (docs/how-to/robots/set-up-uwb.md). Raises `AppError` for a name that
        is no robot, and without a bus."""
        if robot not in self.swarm:
            raise AppError(f"robot.distance({robot!r}): the robots are {', '.join(self.swarm)}")
        return self._ranging().distance(robot)

    @property
    def pose(self) -> "PoseView | None":
        """The robot's place: `x`, `y`, `sigma_x`, `sigma_y` (m), `heading`, `sigma_heading` (rad) and `age` (s).

        None if it is not known. Keep it out of the state of a SyncApp. Raises `AppError` without a bus."""
        return self._devices().pose

    # -- the body

    @property
    def posture(self) -> str:
        """Tell how the robot stands or lies: "standing", "standing_up", "lying_down", "front" or "back" (it lies on
        that side), "upright" (somebody holds it), "leaning", or "unknown" before the first message of the balancer."""
        return self._devices().posture

    @property
    def fault(self) -> str:
        """The reason why the balancer keeps the motors off; empty if there is none."""
        return self._devices().fault

    @property
    def battery(self) -> float | None:
        """The battery's voltage, V; None before the first reading, and where none came for 60 s."""
        return self._devices().battery

    @property
    def buttons(self) -> tuple[str, ...]:
        """The buttons that are held at this moment: any of "a", "b" and "c". `on_button` is called for each press."""
        return self._devices().buttons

    def leds(
        self,
        red: bool | None = None,
        yellow: bool | None = None,
        green: bool | None = None,
        *,
        at: float | None = None,
    ) -> None:
        """Switch LEDs on (True) or off (False) at once, or at the time `at` (s, by `now`, at most 10 s ahead).

        An LED that is left out stays as it is. An order cancels earlier orders for the same time or later ones.
        `clock.monotonic` converts the swarm's common time for `at`. A time that has passed counts as now. When the app
        ends, the LEDs show the robot's own state again. Raises `AppError` without a bus."""
        self._devices().leds(red, yellow, green, at)

    def display(self, *lines: object) -> None:
        """Show up to four lines of 21 letters on the display. Without lines it shows the app's values again."""
        self._devices().display(lines)

    def drive(self, speed: float, turn: float) -> None:
        """Drive with this `speed` (m/s, forward) and `turn` rate (rad/s, to the left) until the next call.

        The robot drives only while it stands, and within its limits. It stops at `drive(0, 0)`, and when the app ends
        or hangs. In a synchronous app it also stands still at the last iteration, and while no step is made for 2 s,
        since a neighbour is missing. Raises `AppError` for numbers that are not finite, and without a bus."""
        self._devices().drive(speed, turn)

    def stand_up(self) -> None:
        """Stand up and balance. If the robot cannot do it, it stays where it is and `fault` has the reason."""
        self._devices().mode("stand")

    def lie_down(self) -> None:
        """Lie down gently."""
        self._devices().mode("lie")

    # -- messages

    def flood(self, payload: bytes, *, priority: str = "bulk", announce: bool = False) -> "Handle[Flooded]":
        """Carry a payload of at most 960 KiB to the same app on all robots.

        With `announce` all robots learn when all have it. A step must not wait for the answer: it keeps the handle's
        `ticket` and asks `answer` later. An event-driven app gets it in `on_answer`. A step that is repeated after a
        restart sends the payload again. Raises `AppError` without a bus."""
        return self._reach().flood(payload, priority=priority, announce=announce)

    def send(self, to: str, payload: bytes, *, priority: str = "bulk", timeout: float = 30.0) -> "Handle[Sent]":
        """Carry a payload of at most 960 KiB to the same app on the robot `to`, within `timeout` s or not at all.

        The answer comes as that of `flood`. Raises `AppError` without a bus."""
        return self._reach().send(to, payload, priority=priority, timeout=timeout)

    def answer(self, ticket: str) -> Flooded | Sent | None:
        """Return the result of a flood or message that this process sent; None as long as it is not known."""
        return self._reach().answer(ticket)

    def messages(self) -> "list[Message]":
        """Return the messages that arrived since the last call: at most the newest 256, from the same app elsewhere.

        Each has `sender`, `payload` (bytes) and `flooded`. Their time of arrival differs in each run, so keep them out
        of the state of a SyncApp. An event-driven app gets them in `on_message` instead."""
        return self._reach().messages()

    def publish(self, topic: str, value: Value | Mapping[str, Value]) -> None:
        """Publish a value, or several by name, on the key `swarm/<robot>/app/<app>/out/<topic>`.

        `swarm view` and `z_sub` show it. Raises `AppError` for a topic that is no part of a key, for a value of a wrong
        type, and without a bus."""
        if self.bus is None:
            raise AppError(f"robot.publish {NEEDS_BUS}")
        if not is_key(topic):
            raise AppError(f"robot.publish({topic!r}): {KEY_PART}, with / between parts")
        given = dict(value) if isinstance(value, Mapping) else {"value": value}
        try:
            values = {name: as_value(item) for name, item in given.items()}
        except LocalError as error:
            raise AppError(f"robot.publish({topic!r}): {error}") from None
        self.bus.publish(key(self.name, f"app/{self.app}", "out", topic), AppOutput(self.now, values))

    def record(self, name: str, value: Value) -> None:
        """Write a value into the run's recording, with this name and the time of `now`; `swarm view` shows it, too.

        All values of a name have one type. Without a recording nothing happens. Raises `AppError` for a name that is
        no part of a key, and for a value that cannot be recorded."""
        if self.recording is not None:
            if not is_key(name) or "/" in name:
                raise AppError(f"robot.record({name!r}): {KEY_PART}")
            try:
                self.recording(name, self.now, as_value(value))
            except LocalError as error:
                raise AppError(f"robot.record({name!r}): {error}") from None

    # -- inside

    def prepare(self, label: str, measurement: Measurement | None) -> None:
        """Called by the host before `start` and before each step."""
        self._label, self._random, self._measurement = label, None, measurement

    def begin_step(self, k: int) -> None:
        """Called by the host when step k begins. One that is done again has the same `dt`."""
        if self._stepped is not None and self._stepped[0] == k:
            return
        now = self.time()
        self.dt = 0.0 if self._stepped is None else now - self._stepped[1]
        self._stepped = k, now

    def _ranging(self) -> "Ranging":
        if self.ranging is None:
            raise AppError(f"robot.ranges or robot.distance {NEEDS_BUS}")
        return self.ranging

    def _devices(self) -> "Devices":
        if self.devices is None:
            raise AppError(f"a device of the robot, such as robot.pose or robot.leds, {NEEDS_BUS}")
        return self.devices

    def _reach(self) -> "Overlays":
        if self.overlays is None:
            raise AppError(f"robot.flood, send, answer or messages {NEEDS_BUS}")
        return self.overlays
