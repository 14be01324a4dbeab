"""The base of distributed algorithms: an author writes a class with a typed state and a step.

    from math import fsum

    class Consensus(SyncApp):
        value: float

        def step(self, neighbours):
            self.value += fsum(w * (n.value - self.value) for w, n in self.weighted(neighbours))

All robots step together: `step` runs when the states of iteration k of all neighbours are there, and turns
the own state k into k + 1. A step is a pure function of what it is given (no clock, no files, no unordered
iteration): then a run is the same bit for bit whatever is cut, killed or restarted meanwhile. See
docs/reference/apps.md. Apps that react to events, or step each by their own clock, are in `swarm.app.event_app`.
"""

import copy
import difflib
import inspect
import math
from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, cast

from swarm.app.parameters import Parameter, parameter
from swarm.app.robot import Robot
from swarm.app.spec import PLATFORM_MODULES, Spec, checked, read_spec
from swarm.core.arrays import shape_of
from swarm.core.state import type_of
from swarm.errors import AppError, shown
from swarm.messages.codec import Value

_MUTABLE = (list, dict, set, bytearray, deque)
"""Types of values that robots would change for each other if they shared them. Arrays are such, too."""

WEIGHTS = ("metropolis", "row")
"""Consensus weights: Metropolis (symmetric, the mean) or row-normalised adjacency (thesis rule 4.1)."""


class BaseApp:
    """The base class of all kinds of apps: SyncApp, EventApp and PeriodicApp.

    Annotated class attributes are the state. A field is shared with the neighbours, or private if its name starts with
    an underscore (the robot never sends it). A shared field starts with its default value in the class, or at zero.
    `swarm.toml` and `--set` can give another first value, and `start` may set one, too.
    """

    weights: str = parameter("metropolis", choices=WEIGHTS)
    view_extras: ClassVar[tuple[str, ...]] = ()
    """Attributes that a neighbour has beside `name` and the shared fields."""
    live: ClassVar[bool] = False
    """Whether parameters that do not declare `live` may be changed while the app runs."""
    plotted: ClassVar[Sequence[str]] = ()
    """Names of states and results, or of entries as `v[1]`, that pictures of a run show, in this order; if empty, the
    picture chooses."""
    spec: ClassVar[Spec]
    robot: Robot
    neighbours: Sequence[Any]
    """The neighbours whose states are known, sorted by name; in a step the same as its argument."""
    k: int
    """The iteration: the number of the state that the step starts from."""

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        try:
            cls.spec = read_spec(cls)
            if cls.__module__ not in PLATFORM_MODULES:
                _check_untyped(cls)
        except AppError as error:
            raise AppError(f"class {cls.__name__}: {error}") from None
        names = cls.plotted
        if not isinstance(names, tuple | list) or not all(isinstance(name, str) for name in names):
            raise AppError(f'class {cls.__name__}: plotted: expected names, e.g. ("x",), got {shown(names)}')

    def __init__(self, robot: Robot, values: Mapping[str, object] | None = None) -> None:
        """Make the app of one robot. `values`: parameters and first values by name.

        Raises `AppError` for a name that the class does not declare, and for a value that does not fit."""
        spec = type(self).spec
        self.check_state()
        self.check_step()
        fields = {f.name: f for f in spec.schema.fields}
        given = dict(values or {})
        for name, setting in spec.parameters.items():
            self._put(name, checked(setting, name, given.pop(name)) if name in given else setting.default)
        for name, shared in fields.items():
            start = given.pop(name) if name in given else getattr(type(self), name, shared.zero)
            self._put(name, checked(shared, name, start))
        for name in spec.private:
            if name in spec.arrays:
                declared = spec.arrays[name]
                self._put(name, checked(declared, name, getattr(type(self), name, declared.zero)))
            elif hasattr(type(self), name):
                self._put(name, copy.deepcopy(getattr(type(self), name)))
        if given:
            known = ", ".join(self.setting_names())
            raise AppError(f"unknown parameter {min(given)!r}; {type(self).__name__} has {known}")
        self._put("robot", robot)
        self._put("neighbours", ())
        self._put("k", 0)
        self._weigh()

    def start(self) -> None:
        """Set the first state. The host calls it once, before the first step. An app need not define it."""

    def result(self) -> Mapping[str, Value]:
        """Return what the run reports: numbers, texts or lists by name, always of the same names and lengths.

        By default it is the shared state. The host calls it after each step or handler, before the new state goes to
        the neighbours: it must be cheap, since a slow one slows a lockstep's whole swarm."""
        schema = type(self).spec.schema
        return schema.message_values({name: getattr(self, name) for name in schema.names})

    def neighbour_weights(self) -> Mapping[str, float]:
        """Return the consensus weight w_ij of each neighbour, by name; the parameter `weights` chooses the rule.

        Override it for other weights. It must be a pure function of parameters and `self.robot`; the host calls it
        before `start`, and again when members or parameters change."""
        graph = self.robot.graph
        return (graph.row_weights if self.weights == "row" else graph.metropolis_weights)(self.robot.name)

    def weighted(self, neighbours: Sequence[Any]) -> list[tuple[float, Any]]:
        """Return pairs of consensus weight w_ij (`neighbour_weights`) and neighbour, in the order of `neighbours`."""
        weights = self.robot.weights
        return [(weights[neighbour.name], neighbour) for neighbour in neighbours]

    @classmethod
    def check_step(cls) -> None:
        """Raise `AppError`, with file and line of the class, where an app that steps has no `step` of its own."""
        step = getattr(cls, "step", None)
        if step is None or step.__module__ not in PLATFORM_MODULES:
            return
        methods = _methods(cls)
        has = f"; it has {', '.join(method.__name__ for method in methods)}" if methods else ""
        raise AppError(f"{_place(cls)}class {cls.__name__} has no step: add `def step(self, neighbours):`{has}")

    @classmethod
    def check_state(cls) -> None:
        """Raise `AppError` where the shared state cannot be sent."""
        own = {name: value for name, value in vars(cls).items() if not hasattr(cls.__base__, name) and name[0] != "_"}
        untyped = next(((name, kind) for name, value in own.items() if (kind := _type_of(value))), None)
        if not cls.spec.schema.fields and untyped is not None:
            name, kind = untyped
            raise AppError(
                f"{_place(cls)}class {cls.__name__} shares no state: {name} has no type: declare `{name}: {kind} = ...`"
            )
        cls.spec.schema.check_size()

    @classmethod
    def setting_names(cls) -> tuple[str, ...]:
        """Return the names of all parameters and first values."""
        return (*cls.spec.parameters, *cls.spec.schema.names)

    @classmethod
    def check_change(cls, values: Mapping[str, object]) -> dict[str, Value]:
        """Other values for live parameters as the app gets them; `AppError` where one of them cannot be changed so."""
        parameters = cls.spec.parameters
        found = {}
        for name, value in values.items():
            declared = parameters.get(name)
            if declared is None:
                raise AppError(f"unknown parameter {name!r}; {cls.__name__} has {', '.join(parameters)}")
            if not declared.live:
                raise AppError(f"{name}: cannot be changed while the app runs: it is declared without live=True")
            found[name] = cast(Value, checked(declared, name, value))
        return found

    def told_parameters(self) -> dict[str, tuple[Parameter, Value]]:
        """Return the declaration and the present value of each parameter by name, for the host to publish."""
        return {name: (declared, getattr(self, name)) for name, declared in type(self).spec.parameters.items()}

    def layouts(self) -> dict[str, str]:
        """Return the layout of the shared state in frames, under an empty name (see `AppParameters.states`)."""
        schema = type(self).spec.schema
        return {"": schema.layout} if schema.fields else {}

    def change(self, values: Mapping[str, Value]) -> None:
        """Called by the host between two handlers or steps, with what `check_change` gave."""
        for name, value in values.items():
            self._put(name, value)
        self._weigh()

    def mix(self, name: str) -> Any:
        """Return the weighted sum of a shared field, x_i + sum of w_ij (x_j - x_i) over the neighbours j.

        The result is a float, tuple or array with the shape of the field. `self.x = self.mix("x")` is a step of
        consensus. It has the same bits on every machine: `fsum` adds floats, and entries of arrays are added in the
        order of the neighbours' names. Raises `AppError` for a field that does not hold floats."""
        field = next((each for each in type(self).spec.schema.fields if each.name == name), None)
        if field is None or field.kind not in ("float", "float32", "vector", "matrix", "array"):
            kinds = ", ".join(f"{each.name} ({each.kind})" for each in type(self).spec.schema.fields)
            raise AppError(f"mix({name!r}): expected a shared field of floats; there are {kinds}")
        own, around = getattr(self, name), [(w, getattr(n, name)) for w, n in self.weighted(self.neighbours)]
        if field.kind == "array":
            return own + sum(weight * (other - own) for weight, other in around)
        return _mixed(own, around)

    def __setattr__(self, name: str, value: object) -> None:
        spec = type(self).spec
        if name in spec.arrays:
            object.__setattr__(self, name, spec.arrays[name].assigned(name, value))
            return
        if name in spec.schema.names or name in spec.private:
            if type(value) is not float and name in spec.schema.names:
                spec.schema.fields[spec.schema.names.index(name)].check_assigned(value)
            object.__setattr__(self, name, value)
            return
        kind = type(self).__name__
        if name in spec.parameters:
            raise AttributeError(
                f"{kind}.{name} is a parameter, a step cannot change it; swarm.toml or --set {name}=... can"
            )
        plain = name.lstrip("_")
        declared = (*spec.schema.names, *spec.private)
        near = difflib.get_close_matches(name, declared, n=1)
        mend = f"Is {near[0]!r} meant? Else declare" if near else "Declare"
        type_name = _type_of(value)
        shared = f"`{plain}: {type_name}` is shared with the neighbours, " if type_name else ""
        private = f"_{plain}: {type_name or type(value).__name__}"
        raise AttributeError(
            f"{kind} declares no {name!r}, it declares {', '.join(declared) or 'nothing'}. {mend} it in the class: "
            f"{shared}`{private}` is private"
        )

    def _weigh(self) -> None:
        robot = self.robot
        weights = dict(self.neighbour_weights())
        if set(weights) != set(robot.neighbours) or not all(map(math.isfinite, weights.values())):
            raise AppError(
                f"neighbour_weights: expected a finite number for each of {', '.join(robot.neighbours) or 'nobody'}, "
                f"got {weights!r}"
            )
        robot.weights = weights
        robot.own_weight = 1.0 - math.fsum(weights.values())

    def _put(self, name: str, value: object) -> None:
        object.__setattr__(self, name, value)


class SyncApp(BaseApp):
    """Base of apps that step together with their neighbours, in lockstep.

    `step` runs when the states of iteration k of all neighbours are there, and turns this robot's state k into k + 1.
    Keep it a pure function: without clock, files and random numbers but `self.robot.random`. A run then gives the same
    bits when links are cut and processes are killed. Private fields are saved for a restart, so they must have types
    that msgpack can hold.
    """

    diverges_above: float = parameter(1e30, low=0.0)
    """Largest absolute value of a shared number; beyond it the app stops with a fault, because it diverges."""
    measured: ClassVar[bool] = False
    """True gives the app a new `robot.measurement` before `start` and before each step."""

    def step(self, neighbours: Sequence[Any]) -> None:
        """Turn the own state k into k + 1, by assigning to the fields of `self`.

        `neighbours`: the states k of all neighbours, sorted by name; each has `name` and the shared fields."""
        raise NotImplementedError

    def converged(self) -> bool | None:
        """Return whether this robot has converged; None leaves the decision to the change of its shared numbers.

        The host calls it after each step of a run with `--until converged`. It must be as pure as a step."""
        return None

    def on_epoch(self, members: Sequence[str]) -> None:
        """Adapt the state to new members of the run, or to new links.

        The host calls it when all members have gone over to the new epoch. `members`: names of the robots in it.
        `robot.neighbours`, `robot.weights` and `robot.swarm` are the new ones. An algorithm whose state holds a history
        changes it here so that it fits the members. It must be as pure as a step. The host calls `start` first on a
        robot that is new to the run."""

    def regraph(self) -> None:
        """Called by the host when `robot.graph` is another one: the weights follow from it."""
        self._weigh()


def _check_untyped(cls: type[BaseApp]) -> None:
    """Raise `AppError` for a list, array or the like in the class that all robots of a simulation would share."""
    bases = [base for base in cls.__mro__ if base is not object and base.__module__ not in PLATFORM_MODULES]
    declared = {
        *cls.spec.parameters,
        *dir(BaseApp),
        *(name for each in bases for name in inspect.get_annotations(each)),
    }
    for name, value in ((name, value) for base in bases for name, value in vars(base).items()):
        if name in declared or name.isupper() or name[:2] == name[-2:] == "__":
            continue  # a name in capitals is a constant, by Python's convention
        if isinstance(value, _MUTABLE) or shape_of(value):
            kind = _type_of(value)
            mend = f"{name}: {kind}" if kind else f"_{name.lstrip('_')}: {type(value).__name__}"
            raise AppError(
                f"{name} has no type, so all robots of a simulation would share it: declare `{mend} = ...`, or write "
                "it in capitals if it never changes"
            )


def _type_of(value: object) -> str:
    """Return the type as which a shared field with this value is declared; empty where there is none."""
    shape = shape_of(value)
    return f"Array[{', '.join(map(str, shape))}]" if shape else type_of(value)


def _methods(cls: type) -> list[Any]:
    return [value for value in vars(cls).values() if inspect.isfunction(value)]


def _place(cls: type) -> str:
    """File and line of a class, with a colon; empty where they are unknown."""
    try:
        return f"{inspect.getsourcefile(cls)}, line {inspect.getsourcelines(cls)[1]}: "
    except (OSError, TypeError):  # a class of a notebook's cell has no file, its methods do
        code = next((method.__code__ for method in _methods(cls)), None)
        return f"{code.co_filename}, line {code.co_firstlineno}: " if code is not None else ""


def _mixed(own: Any, around: Sequence[tuple[float, Any]]) -> Any:
    """`BaseApp.mix` of floats, nested in tuples as they may be."""
    if isinstance(own, tuple):
        return tuple([_mixed(x, [(w, other[i]) for w, other in around]) for i, x in enumerate(own)])
    return own + math.fsum([w * (other - own) for w, other in around])
