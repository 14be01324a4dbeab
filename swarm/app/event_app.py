"""Apps that do not step together: handlers of events, and steps by a clock of one's own.

    class Blink(PeriodicApp):
        on: bool

        def step(self, neighbours):
            self.on = not self.on
            self.robot.leds(green=self.on)

Handlers run one at a time. After each, the shared state goes to the neighbours where it has changed, and at least once
a second; a neighbour's newest state is there in `self.neighbours` and in `step`, with its age. A robot that is away
holds up nobody. See docs/reference/apps.md. A lockstep may run within such an app: `channel`.
"""

import copy
import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, cast

from swarm.app.parameters import Parameter, parameter
from swarm.app.robot import Robot
from swarm.app.spec import checked
from swarm.app.sync_app import BaseApp, SyncApp
from swarm.core.state import Item
from swarm.errors import AppError
from swarm.messages import Flooded, Sent
from swarm.messages.codec import Value

if TYPE_CHECKING:
    from swarm.app.overlays import Message

SHORTEST_PERIOD = 0.01
"""The shortest period, s: a Pi has other things to do."""


class EventApp(BaseApp):
    """Base of apps that react to events. An app defines only the handlers that it needs.

    Private fields may have any type, because a process that restarts begins with `start` again.
    """

    barrier: ClassVar[bool] = False
    """Whether steps wait until all robots of the run are there."""
    view_extras: ClassVar[tuple[str, ...]] = ("age",)
    live: ClassVar[bool] = True
    neighbours: tuple[Any, ...]
    """The newest known states of the neighbours, sorted by name; the host sets them before each handler.

    Each has `name`, the shared fields, and `age`: the seconds since the neighbour sent it, about 1 s at most if the
    neighbour is well. A neighbour that has sent no state is missing."""

    finished: str | None
    """The reason that `finish` got; None before."""

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        if cls.__module__ == __name__:
            return
        known = [name for name in dir(EventApp) if name.startswith("on_")]
        for name in vars(cls):
            if name.startswith("on_") and name not in known:
                raise AppError(f"class {cls.__name__}: there is no handler {name}, there are {', '.join(known)}")
        if hasattr(cls, "step") and not issubclass(cls, PeriodicApp):
            raise AppError(f"class {cls.__name__}: an EventApp has no steps; a PeriodicApp has")
        if hasattr(cls, "measured"):
            raise AppError(
                f"class {cls.__name__}: measured: only a SyncApp is given a measurement for each step; "
                "self.robot.pose and ranges are there at any time"
            )

    def __init__(self, robot: Robot, values: Mapping[str, object] | None = None) -> None:
        """See `BaseApp`. Values named `CHANNEL_NAME` are parameters and first values of a channel."""
        rest, mine = dict(values or {}), {}
        for name, declared in channels_of(type(self)).items():
            prefix = f"{name}_"
            names = declared.names
            mine[name] = {key: rest.pop(prefix + key) for key in names if prefix + key in rest}
        super().__init__(robot, rest)
        self._put("finished", None)
        for name, declared in channels_of(type(self)).items():
            try:
                self._put(name, ChannelView(name, declared, robot, mine[name]))
            except AppError as error:
                raise AppError(f"channel {name}: {error}") from None

    @classmethod
    def setting_names(cls) -> tuple[str, ...]:
        """See `BaseApp`; `CHANNEL_NAME` is a parameter or a first value of a channel."""
        channels = channels_of(cls).items()
        return (*super().setting_names(), *(f"{part}_{name}" for part, each in channels for name in each.names))

    def start(self) -> None:
        """Set the first state. The host calls it once, when the process has started."""

    def on_button(self, button: str) -> None:
        """React to a press of a button of the robot: "a", "b" or "c"."""

    def on_message(self, message: "Message") -> None:
        """React to a message of the same app on another robot.

        `message` has `sender` (a robot's name), `payload` (bytes) and `flooded` (False if it went to this robot)."""

    def on_answer(self, ticket: str, outcome: Flooded | Sent) -> None:
        """React to the result of a flood or message of this app.

        `ticket`: that of the handle which `flood` or `send` returned."""

    def on_announced(self, origin: str, outcome: Flooded) -> None:
        """React to the news that all robots in reach have a flood of another robot with `announce`; `outcome` names
        them."""

    def on_neighbour(self, neighbour: Any) -> None:
        """React to a new state of a neighbour. If it has changed several times since the last call, this is the
        newest state."""

    def on_parameter(self, name: str) -> None:
        """React to a changed parameter: `self` already has the new value under this name."""

    def on_timer(self, name: str) -> None:
        """React to the timer that `self.robot.after(seconds, name)` has set."""

    def finish(self, reason: str = "") -> None:
        """End the app's work on this robot: no handler is called any more, and others can still read its state."""
        self._put("finished", reason)

    @classmethod
    def check_change(cls, values: Mapping[str, object]) -> dict[str, Value]:
        """See `BaseApp`; `CHANNEL_NAME` is a parameter of a channel."""
        found: dict[str, Value] = {}
        for name, value in values.items():
            part, inner = cls._of_channel(name)
            if part is None:
                found |= super().check_change({name: value})
                continue
            try:
                found[name] = channels_of(cls)[part].kind.check_change({inner: value})[inner]
            except AppError as error:
                raise AppError(f"channel {part}: {error}") from None
        return found

    def told_parameters(self) -> dict[str, tuple[Parameter, Value]]:
        """See `BaseApp`; those of channels behind its own."""
        found = super().told_parameters()
        for part in channels_of(type(self)):
            told = getattr(self, part).app.told_parameters()
            found |= {f"{part}_{name}": known for name, known in told.items()}
        return found

    def layouts(self) -> dict[str, str]:
        """See `BaseApp`; those of channels by their names."""
        inner = {part: getattr(self, part).app.layouts() for part in channels_of(type(self))}
        return super().layouts() | {part: told[""] for part, told in inner.items() if told}

    def change(self, values: Mapping[str, Value]) -> None:
        """See `BaseApp`. A channel's parameters change with its next step, perhaps a little later."""
        mine: dict[str, Value] = {}
        for name, value in values.items():
            part, inner = self._of_channel(name)
            if part is None:
                mine[name] = value
            else:
                getattr(self, part).change({inner: value})
        super().change(mine)

    @classmethod
    def _of_channel(cls, name: str) -> tuple[str | None, str]:
        """Channel and name within it of a parameter; None where it is the app's own."""
        if name not in cls.spec.parameters:
            for part, declared in channels_of(cls).items():
                inner = name.removeprefix(f"{part}_")
                if inner != name and inner in declared.kind.spec.parameters:
                    return part, inner
        return None, name

    @classmethod
    def check_state(cls) -> None:
        """See `BaseApp`; an app that shares nothing is fine."""
        if cls.spec.schema.fields:
            super().check_state()


class PeriodicApp(EventApp):
    """Base of apps that step by a clock of their own without waiting for neighbours, and that also react to events."""

    period: float = parameter(0.1, unit="s", low=SHORTEST_PERIOD, high=3600.0)
    """Seconds between two steps; each robot may have another one. If a step takes longer, the next one is left out."""
    barrier: ClassVar[bool] = True

    def step(self, neighbours: Sequence[Any]) -> None:
        """Do one step. The host calls it every `period`. `neighbours`: the same as `self.neighbours`."""
        raise NotImplementedError


@dataclasses.dataclass(frozen=True)
class ChannelDeclaration:
    """A lockstep of its own inside an event-driven or periodic app."""

    kind: type[SyncApp]
    values: Mapping[str, object]
    """Parameters and first values, on top of the class's own."""

    @property
    def names(self) -> tuple[str, ...]:
        """Return the names of all parameters and shared fields of the channel."""
        return self.kind.setting_names()


def channel(kind: type[SyncApp], **values: object) -> Any:
    """Declare a lockstep channel: `frequency = channel(FrequencyConsensus, gain=0.3)` in the body of an app's class.

    The channel runs by itself, with its own states and messages. In the app, `self.frequency.value` is the field
    `value` of its newest iteration, and `self.frequency.k` is that iteration. `self.frequency.feed(_heard=0.3)` sets a
    private field as an input for its next step. Parameters and first values come from `values`, and from swarm.toml or
    `--set` as `frequency_NAME`. `start` may assign first values, too: `self.frequency.value = 2.0`.

    Raises `AppError` for a class that is no SyncApp.
    """
    if not (isinstance(kind, type) and issubclass(kind, SyncApp)):
        raise AppError(f"channel({kind!r}): expected a class derived from SyncApp")
    return ChannelDeclaration(kind, values)


def channels_of(kind: type[BaseApp]) -> dict[str, ChannelDeclaration]:
    """Return the channels that an app class and its bases declare, by name."""
    found: dict[str, ChannelDeclaration] = {}
    for base in reversed(kind.__mro__):
        found |= {name: value for name, value in vars(base).items() if isinstance(value, ChannelDeclaration)}
    return found


class ChannelView:
    """One channel as its app sees it: the shared fields of the newest iteration, and `k`.

    The host runs `app`, another instance with a robot of its own, and hands over each new state by `take`.
    """

    def __init__(self, name: str, declared: ChannelDeclaration, robot: Robot, values: Mapping[str, object]) -> None:
        """Raises `AppError` for a value that the class does not know, or that is out of range."""
        put = super().__setattr__
        seeded = dataclasses.replace(robot, app=f"{robot.app}.{name}")
        put("name", name)
        put("app", declared.kind(seeded, {**declared.values, **values}))
        put("begun", False)
        put("change", self.app.change)
        put("k", 0)
        put("inputs", {})
        put("_values", {field: getattr(self.app, field) for field in declared.kind.spec.schema.names})

    name: str
    app: SyncApp
    begun: bool
    """Whether the host has started it: from then on its state can only be read."""
    change: Callable[[Mapping[str, Value]], None]
    """The function that puts changed parameters in force: at once before the app runs, later as its host decides."""
    k: int
    inputs: dict[str, object]
    """What `feed` gave and no step has taken yet, by field: the host's runner takes it out."""
    _values: Mapping[str, Item]

    def begin(self, change: Callable[[Mapping[str, Value]], None]) -> None:
        """Called by the host when it starts the channel, after the app's `start`. `change(values)` puts other
        parameters in force between two steps."""
        super().__setattr__("begun", True)
        super().__setattr__("change", change)

    def take(self, k: int, values: Mapping[str, Item]) -> None:
        """Called by the host with each new state: unpacked and never changed again."""
        super().__setattr__("_values", values)
        super().__setattr__("k", k)

    def feed(self, **inputs: object) -> None:
        """Give the running lockstep an input: private fields, which its next step finds changed. What it makes of them
        is no function of the start any more; all else of the lockstep holds."""
        spec = type(self.app).spec
        for name, value in inputs.items():
            if name not in spec.private:
                fields = ", ".join(spec.private) or "no private field"
                raise AttributeError(
                    f"channel {self.name}: {name!r} is no input; {type(self.app).__name__} has {fields}"
                )
            # Not into the app itself, which a step may be changing, and which a new epoch puts back. A copy, since the
            # caller may go on with what it has given.
            given = spec.arrays[name].assigned(name, value) if name in spec.arrays else value
            self.inputs[name] = copy.deepcopy(given)

    def __getattr__(self, name: str) -> Item:
        try:
            return self._values[name]
        except KeyError:
            raise AttributeError(f"channel {self.name} has k, {', '.join(self._values)}, but no {name!r}") from None

    def __setattr__(self, name: str, value: object) -> None:
        if self.begun:
            raise AttributeError(f"channel {self.name} has begun: its first values are set in start()")
        fields = {field.name: field for field in type(self.app).spec.schema.fields}
        if name not in fields:
            raise AttributeError(f"channel {self.name} has {', '.join(fields)}, but no {name!r}")
        first = cast(Item, checked(fields[name], name, value))
        setattr(self.app, name, first)
        self.take(0, {**self._values, name: first})
