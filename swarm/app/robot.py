"""What an app sees of the robot it runs on: `self.robot`. The same on robots, simulated ones and in virtual time.

The host puts in what there is: graph and random numbers always, the rest (`overlays`, `mesh_clock`, `ranging`,
`devices`, `bus`...) where the app runs on a bus. An app that asks for what is not there is told so.
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
from swarm.messages.keys import key

if TYPE_CHECKING:  # brings the bus along, which a step in virtual time does without
    from swarm.app.devices import Devices, PoseView
    from swarm.app.mesh_clock import MeshClock
    from swarm.app.overlays import Handle, Message, Overlays
    from swarm.app.ranging import Ranging
    from swarm.app.truth import Truth
    from swarm.bus.protocol import BusLike


@dataclass
class Robot:
    """What an app sees of the robot it runs on."""

    name: str
    graph: Graph
    """The topology of the whole swarm."""
    anchors: tuple[Anchor, ...] = ()
    """UWB modules at known places, m."""
    seed: int = 0
    """Of the swarm's random numbers."""
    log: logging.Logger = field(default_factory=lambda: logging.getLogger("app"))
    weights: Mapping[str, float] = field(default_factory=dict)
    """Consensus weight w_ij of each neighbour, by name."""
    own_weight: float = 1.0
    """w_ii; all weights together are 1."""
    app: str = "app"
    """Name of the app on the bus."""
    time: Callable[[], float] = clock.now
    """The host's clock."""
    bus: "BusLike | None" = None
    """Where the app runs on a robot: that robot's bus."""
    overlays: "Overlays | None" = None
    """Likewise: messages to the whole swarm, or to one robot (docs/how-to/apps/talk-beyond-neighbours.md)."""
    mesh_clock: "MeshClock | None" = None
    """Likewise: the swarm's common time."""
    ranging: "Ranging | None" = None
    """Likewise: distances by UWB."""
    devices: "Devices | None" = None
    """Likewise: the robot's own devices."""
    timers: Callable[[float, str], None] | None = None
    """Put in by the host of an event-driven app: what `after` calls."""
    recording: Callable[[str, float, Value], None] | None = None
    """Put in by the host where the run is recorded: takes name, time and value of what `record` is given."""

    said: Callable[[str, str], None] | None = None
    """Put in by the host: takes level and text of what the app prints or logs."""
    truth: "Callable[[], Truth | None] | None" = None
    """Put in by the host of an app that measures its `error`: what a simulation knows; None as on real robots."""

    def __post_init__(self) -> None:
        self._measurement: Measurement | None = None
        self._label = "start"
        self._stepped: tuple[int, float] | None = None
        self.dt = 0.0
        """s between the beginning of this step and of the one before, by the host's clock; 0 in the first step of a
        process. It is an input of the step, as a measurement is: links and restarts change it, and with it the
        trajectory."""
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
        """Random numbers by the swarm's seed, the robot and the iteration: a repeated step repeats them."""
        if self._random is None:
            self._random = random.Random(f"{self.seed}/{self.name}/{self._label}")
        return self._random

    # -- time

    @property
    def now(self) -> float:
        """Time of the host's clock, s: the robot's monotonic one, virtual in virtual time. It says how long something
        took; what o'clock it is for all robots says `clock`. For what an app does, not for the state of a SyncApp."""
        return self.time()

    @property
    def clock(self) -> "MeshClock":
        """The swarm's common time: `now()`, `error` and `root`, all None until the mesh has told it. For what an app
        does, not for its state: a step that computes with it has another trajectory each time."""
        if self.mesh_clock is None:
            raise AppError("robot.clock needs a bus: it is there when the app runs on a robot")
        return self.mesh_clock

    def after(self, seconds: float, name: str) -> None:
        """Call the app's `on_timer(name)` in so many seconds; said again, it is moved. In event-driven and periodic
        apps."""
        if self.timers is None:
            raise AppError("robot.after: a SyncApp has no timers; EventApp and PeriodicApp do")
        if not (math.isfinite(seconds) and seconds >= 0.0):
            raise AppError(f"robot.after({seconds!r}, {name!r}): expected a time of at least 0 s")
        self.timers(seconds, name)

    # -- UWB

    @property
    def measurement(self) -> Measurement:
        """Range to the target and own place for this step, m. For apps with `measured = True`."""
        if self._measurement is None:
            raise AppError("no measurement: write `measured = True` into the app class to get one before each step")
        return self._measurement

    @property
    def ranges(self) -> tuple[Range, ...]:
        """The newest UWB ranges, to anchors and to robots that carry one; none older than a second. See `clock`."""
        return self._ranging().ranges

    def distance(self, robot: str) -> float | None:
        """The measured distance to another robot, m; None where neither has measured it within the last second: one of
        the two modules has to be an anchor (docs/how-to/robots/set-up-uwb.md). See `clock`."""
        if robot not in self.swarm:
            raise AppError(f"robot.distance({robot!r}): there is no such robot")
        return self._ranging().distance(robot)

    @property
    def pose(self) -> "PoseView | None":
        """Where the robot is: `x`, `y`, `heading`, `sigma_x`, `sigma_y`, `sigma_heading` (m, rad) and `age` (s); None
        where that is not known. See `clock`."""
        return self._devices().pose

    # -- the body

    @property
    def posture(self) -> str:
        """standing, standing_up, lying_down, front or back (it lies on it), upright (held), leaning, or unknown as long
        as the balancer has not told it. See `clock`."""
        return self._devices().posture

    @property
    def fault(self) -> str:
        """Why the balancer keeps the motors off; empty where it does not."""
        return self._devices().fault

    @property
    def battery(self) -> float | None:
        """V; None before it was read."""
        return self._devices().battery

    @property
    def buttons(self) -> tuple[str, ...]:
        """The buttons held at this moment: of "a", "b" and "c". Presses come to `on_button`."""
        return self._devices().buttons

    def leds(
        self,
        red: bool | None = None,
        yellow: bool | None = None,
        green: bool | None = None,
        *,
        at: float | None = None,
    ) -> None:
        """Switch LEDs at once, or at a time `at` of `now` (at most 10 s ahead, to some ms: `clock.monotonic` makes one
        of the swarm's common time); what was ordered for that time and later is void. What is left out stays as the
        app had it. They show the robot's own state again when the app stops or dies."""
        self._devices().leds(red, yellow, green, at)

    def display(self, *lines: object) -> None:
        """Show up to four lines of 21 letters; without any, the app's values again."""
        self._devices().display(lines)

    def drive(self, speed: float, turn: float) -> None:
        """Drive with this speed (m/s, forward) and turn rate (rad/s, left) until told otherwise, as far as the robot
        stands and its limits allow; `drive(0, 0)` stops. It stops, too, when the app does, hangs or dies."""
        self._devices().drive(speed, turn)

    def stand_up(self) -> None:
        """Stand up and balance. A robot that cannot says so in `fault` and stays where it is."""
        self._devices().mode("stand")

    def lie_down(self) -> None:
        """Lie down gently."""
        self._devices().mode("lie")

    # -- messages

    def flood(self, payload: bytes, *, priority: str = "bulk", announce: bool = False) -> "Handle[Flooded]":
        """Carry a payload to the same app on all robots; with `announce` all learn when all have it. A step must not
        wait for the answer: it keeps the handle's `ticket` and looks for the `answer` later (an event-driven app has it
        by `on_answer`). One that is repeated after a restart floods again."""
        return self._reach().flood(payload, priority=priority, announce=announce)

    def send(self, to: str, payload: bytes, *, priority: str = "bulk", timeout: float = 30.0) -> "Handle[Sent]":
        """Carry a payload to the same app on one robot, within `timeout` s or not at all; the same holds."""
        return self._reach().send(to, payload, priority=priority, timeout=timeout)

    def answer(self, ticket: str) -> Flooded | Sent | None:
        """What became of a flood or a message of this process; None as long as that is not known."""
        return self._reach().answer(ticket)

    def messages(self) -> "list[Message]":
        """What the same app on other robots has flooded, and sent to this one, since the last call: at most the newest
        256, each with `sender`, `payload` and `flooded`. They come when they come, and once: see `clock`. To an
        event-driven app they come by `on_message` instead."""
        return self._reach().messages()

    def publish(self, topic: str, value: Value | Mapping[str, Value]) -> None:
        """Tell a value, or several by name, to whoever watches: on the key `swarm/<robot>/app/<app>/out/<topic>`."""
        if self.bus is None:
            raise AppError("robot.publish needs a bus: it is there when the app runs on a robot")
        given = dict(value) if isinstance(value, Mapping) else {"value": value}
        try:
            values = {name: as_value(item) for name, item in given.items()}
        except LocalError as error:
            raise AppError(f"robot.publish({topic!r}): {error}") from None
        self.bus.publish(key(self.name, f"app/{self.app}", "out", topic), AppOutput(self.now, values))

    def record(self, name: str, value: Value) -> None:
        """Write a value into the run's recording, under this name and the time of `now`, and tell it to whoever watches
        the robot. A name's values are all of one type."""
        if self.recording is not None:
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
            raise AppError("robot.ranges and distance need a bus: they are there when the app runs on a robot")
        return self.ranging

    def _devices(self) -> "Devices":
        if self.devices is None:
            raise AppError(
                "robot.pose, posture, battery, buttons, leds, display, drive, stand_up and lie_down need a bus: "
                "they are there when the app runs on a robot"
            )
        return self.devices

    def _reach(self) -> "Overlays":
        if self.overlays is None:
            raise AppError(
                "robot.flood, send, answer and messages need a bus: they are there when the app runs on a robot"
            )
        return self.overlays
