"""What an author of a distributed algorithm writes: a class with a typed state and a step.

    class Consensus(SyncApp):
        value: float

        def step(self, neighbours):
            self.value += sum(w * (n.value - self.value) for w, n in self.weighted(neighbours))

All robots step together: `step` runs when the states of iteration k of all neighbours are there, and turns
the own state k into k + 1. A step is a pure function of what it is given (no clock, no files, no unordered
iteration): then a run is the same bit for bit whatever is cut, killed or restarted meanwhile. See
docs/apps.md.
"""

import copy
import dataclasses
import inspect
import keyword
import logging
import math
import random
import typing
from collections import namedtuple
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

from swarm.codec import Value
from swarm.config.types import Anchor
from swarm.core.graph import Graph
from swarm.core.state import Field, Item, Schema, field_of
from swarm.errors import AppError
from swarm.messages import Flooded, Measurement, Range, Sent

if TYPE_CHECKING:  # brings the bus along, which a step in virtual time does without
    from swarm.mesh_clock import MeshClock
    from swarm.overlays import Handle, Message, Overlays
    from swarm.ranging import Ranging

WEIGHTS = ("metropolis", "row")
"""Consensus weights: Metropolis (symmetric, the mean) or row-normalised adjacency (thesis rule 4.1)."""


@dataclass(frozen=True)
class Parameter:
    """A setting of an app that a step cannot change."""

    default: Value
    unit: str = ""
    low: float | None = None
    high: float | None = None
    choices: tuple[str, ...] = ()
    kind: type = float
    """float, int, bool or str: the annotation."""

    def expected(self) -> str:
        """What a value must be, in words."""
        if self.choices:
            return " or ".join(map(repr, self.choices))
        words = {float: "a finite number", int: "an integer", bool: "true or false", str: "a text"}[self.kind]
        if self.low is not None and self.high is not None:
            words += f" from {self.low:g} to {self.high:g}"
        elif self.low is not None:
            words += f" of at least {self.low:g}"
        elif self.high is not None:
            words += f" of at most {self.high:g}"
        return words + (f" in {self.unit}" if self.unit not in ("", "1") else "")

    def check(self, value: object) -> Value:
        """`value` as the app gets it; `AppError` with what was expected."""
        if self.kind is float and type(value) is int:
            value = float(value)
        fits = type(value) is self.kind and (not self.choices or value in self.choices)
        if fits and isinstance(value, int | float):
            fits = (
                math.isfinite(value)
                and (self.low is None or value >= self.low)
                and (self.high is None or value <= self.high)
            )
        if not fits:
            raise AppError(f"expected {self.expected()}, got {value!r}")
        return typing.cast(Value, value)


def parameter(
    default: Value,
    *,
    unit: str = "",
    low: float | None = None,
    high: float | None = None,
    choices: Sequence[str] = (),
) -> Any:
    """Declare a parameter: `gain: float = parameter(0.5, unit="1", low=0, high=1)`.

    Its value comes from `[apps.NAME]` of swarm.toml, from `[apps.NAME.robots.ROBOT]`, or from `--set`.
    """
    return Parameter(default, unit, low, high, tuple(choices))


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
    overlays: "Overlays | None" = None
    """Where the app runs on a robot's bus: messages to the whole swarm, or to one robot (docs/overlays.md)."""
    mesh_clock: "MeshClock | None" = None
    """Likewise: the swarm's common time."""
    ranging: "Ranging | None" = None
    """Likewise: distances by UWB."""

    def __post_init__(self) -> None:
        self._measurement: Measurement | None = None
        self._label = "start"
        self._random: random.Random | None = None

    @property
    def neighbours(self) -> tuple[str, ...]:
        """Names of the robots linked to this one, sorted."""
        return self.graph.neighbours(self.name)

    @property
    def swarm(self) -> tuple[str, ...]:
        """Names of all robots, in the order of swarm.toml."""
        return self.graph.names

    @property
    def measurement(self) -> Measurement:
        """Range to the target and own place for this step, m. For apps with `measured = True`."""
        if self._measurement is None:
            raise AppError("no measurement: write `measured = True` into the app class to get one before each step")
        return self._measurement

    @property
    def random(self) -> random.Random:
        """Random numbers by the swarm's seed, the robot and the iteration: a repeated step repeats them."""
        if self._random is None:
            self._random = random.Random(f"{self.seed}/{self.name}/{self._label}")
        return self._random

    @property
    def clock(self) -> "MeshClock":
        """The swarm's common time: `now()`, `error` and `root`, all None until the mesh has told it. For what an app
        does, not for its state: a step that computes with it has another trajectory each time."""
        if self.mesh_clock is None:
            raise AppError("robot.clock needs a bus: it is there when the app runs on a robot")
        return self.mesh_clock

    @property
    def ranges(self) -> tuple[Range, ...]:
        """The newest UWB ranges, to anchors and to robots that carry one; none older than a second. See `clock`."""
        return self._ranging().ranges

    def distance(self, robot: str) -> float | None:
        """The measured distance to another robot, m; None where neither has measured it within the last second: one of
        the two modules has to be an anchor (docs/uwb.md). See `clock`."""
        if robot not in self.swarm:
            raise AppError(f"robot.distance({robot!r}): there is no such robot")
        return self._ranging().distance(robot)

    def _ranging(self) -> "Ranging":
        if self.ranging is None:
            raise AppError("robot.ranges and distance need a bus: they are there when the app runs on a robot")
        return self.ranging

    def flood(self, payload: bytes, *, priority: str = "bulk", announce: bool = False) -> "Handle[Flooded]":
        """Carry a payload to the same app on all robots; with `announce` all learn when all have it. A step must not
        wait for the answer: it keeps the handle's `ticket` and looks for the `answer` later. One that is repeated
        after a restart floods again."""
        return self._reach().flood(payload, priority=priority, announce=announce)

    def send(self, to: str, payload: bytes, *, priority: str = "bulk", timeout: float = 30.0) -> "Handle[Sent]":
        """Carry a payload to the same app on one robot, within `timeout` s or not at all; the same holds."""
        return self._reach().send(to, payload, priority=priority, timeout=timeout)

    def answer(self, ticket: str) -> Flooded | Sent | None:
        """What became of a flood or a message of this process; None as long as that is not known."""
        return self._reach().answer(ticket)

    def messages(self) -> "list[Message]":
        """What the same app on other robots has flooded, and sent to this one, since the last call: at most the newest
        256, each with `sender`, `payload` and `flooded`. They come when they come, and once: see `clock`."""
        return self._reach().messages()

    def _reach(self) -> "Overlays":
        if self.overlays is None:
            raise AppError(
                "robot.flood, send, answer and messages need a bus: they are there when the app runs on a robot"
            )
        return self.overlays

    def prepare(self, label: str, measurement: Measurement | None) -> None:
        """Called by the host before `start` and before each step."""
        self._label, self._random, self._measurement = label, None, measurement


@dataclass(frozen=True)
class Spec:
    """What a class declares: found out when the class is made."""

    schema: Schema
    private: tuple[str, ...]
    parameters: Mapping[str, Parameter]
    view: Any
    """The named tuple in which a step sees a neighbour: `name` and the shared fields."""


class SyncApp:
    """Base of apps that step together with their neighbours. See the module's text and docs/apps.md.

    Annotated class attributes are the state: shared with the neighbours, or private where the name starts
    with an underscore (saved for a restart, never sent). A default value in the class, or a parameter of the
    same name on top of it, is the first value of a shared field; `start` may set another one. Without any it
    starts at zero.
    """

    weights: str = parameter("metropolis", choices=WEIGHTS)
    measured: ClassVar[bool] = False
    """True = before `start` and before each step there is a new `robot.measurement`."""
    spec: ClassVar[Spec]
    robot: Robot
    k: int
    """The iteration: the number of the state that the step starts from."""

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        try:
            cls.spec = _spec(cls)
        except AppError as error:
            raise AppError(f"class {cls.__name__}: {error}") from None

    def __init__(self, robot: Robot, values: Mapping[str, object] | None = None) -> None:
        """`values`: parameters and first values by name. `AppError` for one the class does not know."""
        spec = type(self).spec
        spec.schema.check_size()
        fields = {f.name: f for f in spec.schema.fields}
        given = dict(values or {})
        for name, declared in spec.parameters.items():
            self._put(name, _checked(declared, name, given.pop(name)) if name in given else declared.default)
        for name, shared in fields.items():
            start = given.pop(name) if name in given else getattr(type(self), name, shared.zero)
            self._put(name, _checked(shared, name, start))
        for name in spec.private:
            if hasattr(type(self), name):
                self._put(name, copy.deepcopy(getattr(type(self), name)))
        if given:
            known = ", ".join([*spec.parameters, *fields])
            raise AppError(f"unknown parameter {min(given)!r}; {type(self).__name__} has {known}")
        weights = robot.graph.row_weights if self.weights == "row" else robot.graph.metropolis_weights
        robot.weights = weights(robot.name)
        robot.own_weight = 1.0 - math.fsum(robot.weights.values())
        self._put("robot", robot)
        self._put("k", 0)

    def start(self) -> None:
        """Set the first state; may be left out."""

    def step(self, neighbours: Sequence[Any]) -> None:
        """Turn the own state k into k + 1, given all neighbours' states k, sorted by name."""
        raise NotImplementedError

    def result(self) -> Mapping[str, Value]:
        """What the run reports, always under the same names; by default the shared state."""
        return {name: getattr(self, name) for name in type(self).spec.schema.names}

    def weighted(self, neighbours: Sequence[Any]) -> list[tuple[float, Any]]:
        """Each neighbour with its consensus weight w_ij (parameter `weights`)."""
        weights = self.robot.weights
        return [(weights[neighbour.name], neighbour) for neighbour in neighbours]

    def __setattr__(self, name: str, value: object) -> None:
        spec = type(self).spec
        if name in spec.schema.names or name in spec.private:
            object.__setattr__(self, name, value)
            return
        kind = type(self).__name__
        if name in spec.parameters:
            raise AttributeError(
                f"{kind}.{name} is a parameter, a step cannot change it; swarm.toml or --set {name}=... can"
            )
        fields = ", ".join((*spec.schema.names, *spec.private)) or "nothing"
        plain = name.lstrip("_")
        raise AttributeError(
            f"{kind} declares no {name!r}, it declares {fields}. Declare it in the class: "
            f"`{plain}: float` is shared with the neighbours, `_{plain}: float = 0.0` is private"
        )

    def _put(self, name: str, value: object) -> None:
        object.__setattr__(self, name, value)


def _checked(declared: Parameter | Field, name: str, value: object) -> Value | Item:
    try:
        return declared.check(value)
    except AppError as error:
        raise AppError(f"{name}: {error}") from None


def _spec(cls: type[SyncApp]) -> Spec:
    """Read the class: annotations are fields or parameters, in declared order, base classes first."""
    if "__init__" in vars(cls):
        raise AppError("an app has no __init__; declare fields in the class and set their first values in start()")
    try:
        hints = typing.get_type_hints(cls, include_extras=True)
    except (NameError, TypeError, SyntaxError) as error:
        raise AppError(f"an annotation cannot be read: {error}") from None
    reserved = {name for name in dir(SyncApp) if not name.startswith("_")} | {"robot", "k", "spec", "name"}
    fields: list[Field] = []
    private: list[str] = []
    parameters: dict[str, Parameter] = {}
    for name, hint in hints.items():
        if typing.get_origin(hint) is ClassVar or hint is ClassVar:
            continue
        default = getattr(cls, name, None)
        if isinstance(default, Parameter):
            parameters[name] = _typed(name, default, hint)
        elif name in reserved:
            if name in inspect.get_annotations(cls):
                raise AppError(f"{name}: this name belongs to the platform, choose another")
        elif name.startswith("_"):
            private.append(name)
        else:
            if keyword.iskeyword(name):
                raise AppError(f"{name}: a word of the Python language cannot be a field")
            fields.append(field_of(name, hint))
    return Spec(
        Schema(cls.__name__, fields),
        tuple(private),
        parameters,
        namedtuple("Neighbour", ["name", *(f.name for f in fields)]),
    )


def _typed(name: str, declared: Parameter, hint: object) -> Parameter:
    kind = typing.get_args(hint)[0] if typing.get_origin(hint) is Annotated else hint
    if kind not in (float, int, bool, str):
        shown = getattr(kind, "__name__", kind)
        raise AppError(f"{name}: a parameter is of type float, int, bool or str, not {shown}")
    typed = dataclasses.replace(declared, kind=kind)
    try:
        return dataclasses.replace(typed, default=typed.check(declared.default))
    except AppError as error:
        raise AppError(f"{name}: default: {error}") from None
