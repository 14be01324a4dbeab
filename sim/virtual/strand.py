"""One lockstep of an app under virtual time: drives `services.apps.core.strand` as `services.apps.worker` does, without
its thread and files."""

from collections.abc import Callable
from typing import NamedTuple, Protocol

from services.apps import ballots
from services.apps.core.strand import ALONE, Renew, Strand
from services.apps.runner import AppRunner, Runner
from sim.virtual.bus import VirtualBus
from sim.virtual.events import Time
from swarm.core.epoch_actions import Keep, Order, Switch, Tell
from swarm.core.epoch_notes import Kept
from swarm.core.lockstep import Advanced, Channel, Compute, Fault, Finished, Send, Waiting
from swarm.errors import AppError
from swarm.messages import AppEpoch, AppProgress, AppState, Measurement
from swarm.messages.codec import Value
from swarm.messages.keys import key

_NEVER = float("inf")


class Line(NamedTuple):
    """What a run has of one iteration of one robot."""

    k: int
    t: float
    state: dict[str, Value]
    result: dict[str, Value]
    measurement: Measurement | None = None
    """What the step that gave this state computed with."""


class Measurements(Protocol):
    """Where an app's measurements come from."""

    def get(self, k: int, ready: Callable[[Measurement], None]) -> None:
        """Call `ready(measurement)` when that of step k is there."""


class Teller(Protocol):
    """What tells of an app's iterations, steps or events: a strand, or the host of an event-driven app."""

    @property
    def robot(self) -> str:
        """Where it runs."""

    @property
    def app(self) -> str:
        """The app's name."""

    @property
    def part(self) -> str:
        """Name of the channel within the app; empty for the app itself."""

    @property
    def runner(self) -> AppRunner:
        """The app."""

    @property
    def reason(self) -> str:
        """Why it has stopped; empty where it has not."""

    @property
    def waiting(self) -> tuple[str, ...]:
        """Robots that are waited for."""

    @property
    def obstacle(self) -> str:
        """What else keeps it from going on; empty where nothing does."""


class Told(NamedTuple):
    """Who is told what becomes of an app."""

    advanced: Callable[[Teller, Line], None]
    """For each iteration of each channel, for each step or event."""
    ended: Callable[[Teller], None]
    """When the last one is done or the app has failed."""
    switched: Callable[[Teller, AppEpoch], None]
    """When the members have changed: the iterations from the epoch's first one on are done again."""
    waits: Callable[[Teller], None]
    """When robots are waited for, others than before or none any more."""


class VirtualStrand:
    """One strand, from the first state to the last iteration."""

    __slots__ = (
        "_advanced",
        "_bus",
        "_channel",
        "_closed",
        "_ended",
        "_epoch_key",
        "_heard",
        "_latest",
        "_measured",
        "_measurements",
        "_notes",
        "_prefix",
        "_progress_key",
        "_shown",
        "_state_key",
        "_switched",
        "_sync",
        "_time",
        "_timer",
        "_waits",
        "app",
        "kept",
        "part",
        "robot",
        "runner",
        "shown_keys",
        "strand",
    )

    def __init__(
        self,
        strand: Strand,
        runner: Runner,
        *,
        robot: str,
        app: str,
        part: str,
        time: Time,
        bus: VirtualBus,
        measurements: Measurements | None,
        told: Told,
        latest: Callable[[int, bytes], None] | None = None,
    ) -> None:
        """`part`: name of the channel within the app, empty for an app that is one lockstep. `latest(k, state)` is
        called with each packed state."""
        self.robot = robot
        self.app = app
        self.part = part
        self.strand = strand
        self.runner = runner
        self._time = time
        self._bus = bus
        self._measurements = measurements
        self._measured: Measurement | None = None
        self._advanced, self._ended, self._switched, self._waits = told
        self.kept: Kept | None = None
        """What a robot keeps through a reboot: its votes."""
        self._closed = False
        self._latest = latest
        self._prefix = key(robot, f"app/{app}", "sync")
        self._channel = strand.channel
        self._sync = f"{self._prefix}/{strand.channel.text}"
        self._notes = f"{self._prefix}/{strand.terms.notes}"
        keys = f"app/{app}/{part}" if part else f"app/{app}"
        self.shown_keys = self._state_key, self._progress_key = key(robot, keys, "state"), key(robot, keys, "progress")
        """Where `show` tells."""
        self._epoch_key = key(robot, keys, "epoch")
        self._shown: tuple[str, int, tuple[str, ...], str] | None = None
        self._heard = False
        """Whether it is planned to do what the frames of this moment call for."""
        self._timer = _NEVER

    @property
    def reason(self) -> str:
        """See `Teller`."""
        return self.strand.reason

    @property
    def waiting(self) -> tuple[str, ...]:
        """See `Teller`."""
        return self.strand.waiting

    @property
    def obstacle(self) -> str:
        """See `Teller`."""
        return self.strand.obstacle

    def start(self) -> None:
        """Let the app begin, as soon as there is a measurement for it where it wants one."""
        if self._measurements is None:
            self._begin(None)
        else:
            self._measurements.get(0, self._begin)

    def receive(self, sender: str, channel: Channel, payload: bytes, *, around: bool) -> None:
        """A frame of this run and this strand; `around` a silent link, or over it."""
        self.strand.receive(sender, channel, payload, self._time.now, around=around)
        if not self._heard:  # once for all frames that come in one moment
            self._heard = True
            self._time.soon(self._perform)

    def receive_note(self, sender: str, payload: bytes) -> None:
        """What a robot has to say about the members."""
        self.strand.receive_note(sender, payload, self._time.now)
        self._perform()

    def nudge(self) -> None:
        """A link came up."""
        self.strand.nudge(self._time.now)
        self._perform()

    def order(self, wish: Order) -> None:
        """The operator wants other members."""
        self.strand.order(wish, self._time.now)
        self._perform()

    def close(self) -> None:
        """End as by kill -9."""
        self._closed = True

    def take_rtt(self, rtt: float) -> None:
        """The slowest link's usual round-trip time, s."""
        self.strand.rtt = rtt

    def show(self) -> None:
        """Publish state and progress where they are new and somebody hears them."""
        strand, runner = self.strand, self.runner
        shown = strand.phase, strand.k, strand.waiting, strand.obstacle
        if self._shown == shown:
            return
        self._shown = shown
        if self._bus.wanted(self._progress_key):
            reason = strand.reason or strand.obstacle
            phase = "waiting" if strand.phase == "running" and (strand.waiting or reason) else strand.phase
            progress = AppProgress(self._time.now, phase, strand.k, strand.waiting, reason)
            self._bus.publish(self._progress_key, progress)
        if strand.begun and not strand.reason and self._bus.wanted(self._state_key):
            state = AppState(strand.computed_at, runner.k, runner.state(), runner.result())
            self._bus.publish(self._state_key, state)

    def _begin(self, measurement: Measurement | None) -> None:
        if self._closed:
            return
        try:
            self.strand.begin((), measurement, self._time.now)
        except AppError as error:
            self._fail(str(error))
            return
        self._perform()

    def _compute(self, todo: Compute) -> None:
        if self._measurements is not None:
            self._measurements.get(todo.k, lambda measurement: self._step(todo, measurement))
        elif todo.values:
            self._step(todo, None)
        else:
            self._time.at(self._time.now + ALONE, self._step, todo, None)

    def _step(self, todo: Compute, measurement: Measurement | None) -> None:
        if self._closed or self.strand.phase == "fault":
            return
        try:
            self._measured = measurement
            answer = self.strand.compute(todo, measurement)
        except AppError as error:
            self._fail(str(error))
            return
        self.strand.computed(todo, answer, self._time.now)
        self._perform()

    def _renew(self, todo: Renew) -> None:
        if self._measurements is not None:
            self._measurements.get(todo.epoch.k, lambda measurement: self._change(todo, measurement))
        else:
            self._change(todo, None)

    def _change(self, todo: Renew, measurement: Measurement | None) -> None:
        if self._closed:
            return
        try:
            answer = self.strand.renew(todo.epoch, measurement)
        except AppError as error:
            self._fail(str(error))
            return
        self.strand.renewed(todo.epoch, answer, self._time.now)
        self._perform()

    def _perform(self) -> None:
        """Carry out what the strand wants, in its order."""
        strand = self.strand
        self._heard = False
        if self._closed:
            return
        for action in strand.actions():
            if type(action) is Send:
                if self._channel is not strand.channel:
                    self._channel = strand.channel
                    self._sync = f"{self._prefix}/{self._channel.text}"
                self._bus.publish(action.key(self._sync), action.data, urgent=True)
            elif type(action) is Compute:
                # Not from within: a robot without neighbours would never come back.
                self._time.soon(self._compute, action)
            elif type(action) is Keep:
                self.kept = action.kept
            elif type(action) is Switch:
                told = ballots.told(action.epoch, self._time.now)
                self._bus.publish(self._epoch_key, told)
                self._switched(self, told)
            elif type(action) is Tell:
                self._bus.publish(self._notes, action.data, urgent=True)
            elif type(action) is Renew:
                self._time.soon(self._renew, action)
            elif type(action) is Advanced:
                try:
                    state, result = self.runner.state(), self.runner.result()
                    line = Line(action.k, strand.computed_at, state, result, self._measured)
                except AppError as error:
                    self._fail(str(error))
                    return
                if self._latest is not None:
                    self._latest(action.k, action.value)
                self._advanced(self, line)
            elif type(action) is Waiting:
                self._waits(self)
            elif type(action) is Fault or type(action) is Finished:
                self._ended(self)
        deadline = strand.next_deadline(self._time.now)
        if deadline is not None and deadline < self._timer:
            self._timer = deadline
            self._time.at(deadline, self._tick, deadline)

    def _tick(self, planned: float) -> None:
        if planned != self._timer or self._closed:
            return  # an earlier one came before
        self._timer = _NEVER
        deadline = self.strand.next_deadline(self._time.now)
        if deadline is not None and deadline <= self._time.now:
            self.strand.handle_timer(self._time.now)
        self._perform()

    def _fail(self, reason: str) -> None:
        if self.strand.fail(reason, self._time.now):
            self._ended(self)
