"""An app instance between packed bytes: a `Compute` of the lockstep becomes a call of the author's `step`.

No IO and no clock. Whatever the author's code raises comes out as one `AppError` that names robot, iteration,
file, line and fault.
"""

import copy
import inspect
import math
import numbers
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any, TypeVar

from services.apps.core.terms import Told
from services.apps.faults import called_from, describe, line_of, mend_of
from swarm.app.run_options import TOLERANCE
from swarm.app.spec import PLATFORM_MODULES
from swarm.app.sync_app import BaseApp, SyncApp
from swarm.core.arrays import is_array, shape_of
from swarm.core.graph import Graph
from swarm.core.snapshot_fields import pack_private, unpack_private
from swarm.core.state import Field
from swarm.errors import AppError, LocalError, shown
from swarm.messages import Measurement
from swarm.messages.codec import Value, as_value

T = TypeVar("T")

Form = list[tuple[str, tuple[int, ...]]]
"""Names of a result and their shapes."""

ERROR = "error"
"""An app's method `error(self, truth)`, and the result of that name. Others are `error_heading` and the like."""


BUILT_IN = "services.apps.builtin."
"""Apps of ours, whose errors the report of a simulation knows."""


class AppRunner:
    """The shared part of all runners of apps: the app's state and result, and its faults in words."""

    def __init__(self, app: BaseApp, source: str) -> None:
        """`source`: path of the app's file; a fault is reported with the line in it."""
        self.app = app
        self.schema = type(app).spec.schema
        self.k = 0
        self.source = source
        self._form: Form | None = None
        """Names and shapes of the first result."""
        own = type(app).result is not BaseApp.result and not type(app).__module__.startswith(BUILT_IN)
        self._fields = {field.name: field for field in self.schema.fields} if own else {}
        """The shared state, where the author's own result could name other values alike."""
        self.metrics = metrics_of(type(app))
        """What the app measures of itself where the truth is known."""
        self._running = ""
        """The method of the author that was called last, and when, in words."""

    def told(self) -> Told:
        """Return the shared state and the result. Takes as long as the author's code does."""
        return Told(self.state(), self.result())

    def state(self) -> dict[str, Value]:
        """Return the shared state by name."""
        return self.schema.message_values({name: getattr(self.app, name) for name in self.schema.names})

    def result(self) -> dict[str, Value]:
        """Return the app's result. Its names and shapes never change, as the columns of a recording."""
        where = f"result() at iteration {self.k}"
        answer: object = self._call(where, self.app.result, "result")
        if not isinstance(answer, dict | Mapping) or not all(isinstance(name, str) for name in answer):
            raise self._fault(where, "result", f"expected a dict by name, got {shown(answer)}")
        result = {name: self._value(where, name, value) for name, value in answer.items()}
        for name in self._fields.keys() & result.keys():
            self._check_same(where, self._fields[name], result[name])
        form = [(name, form_of(value)) for name, value in answer.items()]
        if self._form is None:
            self._form = form
        elif form != self._form:
            raise self._fault(where, "result", other_form(form, self._form))
        for name in self.metrics:
            result[name] = self._measured(name, result)
        return result

    @property
    def shapes(self) -> dict[str, tuple[int, ...]]:
        """The shapes of results with several axes that are no states, by name; empty before the first result."""
        return {name: shape for name, shape in self._form or () if len(shape) > 1 and name not in self._fields}

    def known(self, result: Mapping[str, Value]) -> dict[str, Value]:
        """Return a result without metrics that are not known: a message carries finite numbers alone."""
        metrics = self.metrics
        return {
            name: value
            for name, value in result.items()
            if name not in metrics or not isinstance(value, float) or math.isfinite(value)
        }

    def _check_same(self, where: str, field: Field, told: Value) -> None:
        """Raise `AppError` where a result has the name of a state, and another value."""
        own = getattr(self.app, field.name)
        value = as_value(own if field.kind == "float32" else field.message_value(field.check(own)))
        if told != value:
            text = (
                f"its {field.name!r} is {told!r}, and the shared state of that name is {value!r}; "
                f"a recording has one value under a name: give the state or the result another one"
            )
            raise self._fault(where, "result", text)

    def _measured(self, name: str, result: Mapping[str, Value]) -> float:
        """Return a metric by the simulation's truth; nan where that is unknown."""
        robot = self.app.robot
        truth = None if robot.truth is None else robot.truth()
        if truth is None:
            return math.nan
        if not hasattr(type(self.app), name):
            x, y = result.get("x"), result.get("y")
            found = isinstance(x, float) and isinstance(y, float)
            return math.dist((x, y), truth.target) if found else math.nan  # type: ignore[arg-type]
        where = f"{name}() at iteration {self.k}"
        answer: object = self._call(where, lambda: getattr(self.app, name)(truth), name)
        if isinstance(answer, bool) or not isinstance(answer, numbers.Real):  # numpy's numbers are such
            raise self._fault(where, name, f"expected a number, got {shown(answer)}: return a float")
        return float(answer)

    def hangs(self, thread: int | None, limit: float) -> str:
        """Describe code of the author that has run for `limit` s in a thread, with method and line at which it is."""
        return f"{self._where(self._running)}: {line_of(thread, self.source)}it has not ended within {limit:g} s"

    def _be_at(self, k: int) -> None:
        self.k = k
        object.__setattr__(self.app, "k", k)

    def _set(self, own: bytes) -> None:
        arrays = type(self.app).spec.arrays
        for name, value in zip(self.schema.names, self.schema.unpack(own), strict=True):
            # Declared they are: the app's own test is for authors. Unpacked arrays are read-only, the own ones are not.
            object.__setattr__(self.app, name, _own(value) if name in arrays else value)

    def _value(self, where: str, name: str, value: object) -> Value:
        try:
            return as_value(value)
        except LocalError as error:
            raise self._fault(where, "result", f"{name}: {error}") from None

    def _call(self, where: str, function: Callable[[], T], method: str = "") -> T:
        """Call the author's code; `method`: which one of the app's it is, in the place of a line where none is known,
        as of a method with other arguments than it is given."""
        self._running = where
        try:
            return function()
        except AppError as error:
            raise AppError(f"{self._where(where)}: {called_from(error, self.source)}{error}") from None
        except BaseException as error:
            # An author's sys.exit(), or a cancelled task of asyncio, would end this thread alone. Ctrl-C passes.
            if not isinstance(error, Exception | SystemExit) and type(error).__name__ != "CancelledError":
                raise
            text = describe(error, self.source, self._from_line(method))
            hint = mend_of(error, self.schema.fields) or self._arguments(error, method)
            raise AppError(f"{self._where(where)}: {text}{hint}") from error

    def _fault(self, where: str, method: str, text: str) -> AppError:
        """Return what is wrong with a method of the author's where no line of its own is at fault."""
        return AppError(f"{self._where(where)}: {self._from_line(method)}{text}")

    def _from_line(self, method: str) -> str:
        """File and first line of a method of the author's, with a colon, where no line of its own is at fault; empty
        for a method of ours."""
        code = getattr(getattr(type(self.app), method, None), "__code__", None)
        if code is None or code.co_filename != self.source:
            return ""
        return f"{self.source}, from line {code.co_firstlineno} on: "

    def _arguments(self, error: BaseException, method: str) -> str:
        """Explain which arguments a method of the author's must have, where our call of it has failed for them."""
        if not method or not isinstance(error, TypeError) or f"{method}() " not in str(error):
            return ""
        platform = next(kind for kind in type(self.app).__mro__ if kind.__module__ in PLATFORM_MODULES)
        ours = getattr(platform, method, None)
        names = ", ".join(inspect.signature(ours).parameters) if ours is not None else "self, truth"
        return f" (declare `def {method}({names})`)"

    def _where(self, where: str) -> str:
        return f"{type(self.app).__name__} on {self.app.robot.name}, {where}"


def form_of(value: object) -> tuple[int, ...]:
    """Return the shape of a result: of an array, or of lists within lists by their first entries."""
    if type(value) is float:
        return ()
    if isinstance(value, tuple | list):
        return (len(value), *form_of(value[0])) if value else (0,)
    return shape_of(value)


def other_form(form: Form, first: Form) -> str:
    """Return in words how the form of a result differs from that of the first one."""
    names, known = [name for name, _ in form], dict(first)
    if names != list(known):
        return f"it gave {', '.join(names)}, first it was {', '.join(known)}"
    name, shape = next((name, shape) for name, shape in form if shape != known[name])
    return (
        f"its {name!r} is of shape {shape}, first it was {known[name]}; a recording has the same entries in each "
        "iteration: give a list or array of constant length"
    )


def metrics_of(kind: type[BaseApp]) -> tuple[str, ...]:
    """Return the methods `error` and `error_NAME` of an app's class: how far it is from what is true. An author's app
    that ranges to a target and has no `error` has it all the same: how far its results x and y are from the target."""
    names = sorted(name for name in dir(kind) if name == ERROR or name.startswith(f"{ERROR}_"))
    own = tuple(name for name in names if callable(getattr(kind, name)) and name not in kind.spec.schema.names)
    if ERROR in own or not getattr(kind, "measured", False) or kind.__module__.startswith(BUILT_IN):
        return own
    told = {f.name for f in kind.spec.schema.fields} if kind.result is BaseApp.result else {"x", "y"}
    return (ERROR, *own) if {"x", "y"} <= told and ERROR not in kind.spec.schema.names else own


UNDECIDED = "converged() returned None: the change of the state decides, see --tolerance"


class Runner(AppRunner):
    """Drives one app of the synchronous kind from state to state."""

    app: SyncApp

    def __init__(
        self, app: SyncApp, source: str, tolerance: float = TOLERANCE, inputs: dict[str, object] | None = None
    ) -> None:
        """`source`: path of the app's file; a fault is reported with the line in it. `tolerance`: an app that does not
        say itself when it has converged has where no number of its shared state changes by more in a step. `inputs`:
        values of private fields for the next step, which takes them out; another thread may put them in at any
        time."""
        super().__init__(app, source)
        self._tolerance = tolerance
        self._step = b"", b""
        self._changes: dict[str, Value] = {}
        self._inputs = {} if inputs is None else inputs
        self._taken: dict[str, tuple[int, object]] = {}
        """For each field, the iteration whose step took the newest input of this epoch, and that input."""
        self._again: dict[str, object] | None = None
        """The inputs of steps that are done again, before the first step of an epoch; None after that step."""
        self.undecided = False
        """Whether the app's own `converged` has returned None."""
        self.changed: Callable[[], None] | None = None
        """Called when other parameters are in force."""

    def change(self, values: Mapping[str, object]) -> None:
        """Other values for live parameters, from the next step on; `AppError` where one cannot be changed so, and then
        none is."""
        found = type(self.app).check_change(values)
        self._changes = {**self._changes, **found}

    def forget_inputs(self) -> None:
        """Inputs of now are those that the `start` of the app around this one has given again, in a new process: a step
        of the process before has taken them."""
        self._inputs.clear()

    @property
    def size(self) -> int:
        """Bytes of one packed state."""
        return self.schema.size

    def start(self, measurement: Measurement | None) -> tuple[bytes, bytes]:
        """Let the app set its first state; returns it packed: shared, private."""
        self._be_at(0)
        self.app.robot.prepare("start", measurement)
        self._call("start()", self.app.start, "start")
        return self._pack("start()", "start")

    def step(
        self, k: int, own: bytes, values: Mapping[str, bytes], measurement: Measurement | None
    ) -> tuple[bytes, bytes]:
        """Compute x(k+1) from the own x(k) and the neighbours', by name; returns it packed: shared, private.

        The neighbours are handed over sorted by name, so that sums have one order everywhere (rule R8).
        """
        self._be_at(k)
        self._set(own)
        app = self.app
        if self._changes:
            changes, self._changes = self._changes, {}
            self._call(f"iteration {k}", lambda: app.change(changes))
            if self.changed is not None:
                self.changed()
        if self._inputs or self._again is not None:
            self._call(f"iteration {k}", lambda: self._take_inputs(k))
        view, unpack = type(app).spec.view, self.schema.unpack
        app.robot.prepare(str(k), measurement)
        app.robot.begin_step(k)
        neighbours = [view(name, *unpack(values[name])) for name in sorted(values)]
        object.__setattr__(app, "neighbours", neighbours)
        where = f"iteration {k}"
        answer: object = self._call(where, lambda: app.step(neighbours), "step")
        if answer is not None:
            raise self._fault(where, "step", f"it returned {shown(answer)}; a step assigns to the state instead")
        packed = self._pack(where, "step")
        self._be_at(k + 1)
        self._step = own, packed[0]
        return packed

    def restore(self, k: int, own: bytes, private: bytes, graph: Graph) -> None:
        """Be again where a snapshot was taken, among the robots of `graph`."""
        self._be_at(k)
        self._set(own)
        for name, value in unpack_private(private).items():
            setattr(self.app, name, value)
        if graph != self.app.robot.graph:
            self.app.robot.graph = graph
            self._call(f"iteration {k}", self.app.regraph)

    def renew(self, k: int, at: int, own: bytes, private: bytes, graph: Graph) -> tuple[bytes, bytes]:
        """Go over to other robots and links at iteration k, with the state of iteration `at` of the epoch before;
        returns the state the app goes on with, packed. Inputs that steps after that state have taken are for the next
        step, where there is no newer one."""
        self._again = {name: value for name, (taken, value) in self._taken.items() if taken >= at}
        self.restore(k, own, private, graph)
        where = f"on_epoch() at iteration {k}"
        self.app.robot.prepare(f"epoch {k}", None)
        self._call(where, lambda: self.app.on_epoch(graph.names), "on_epoch")
        return self._pack(where, "on_epoch")

    def entered(self, k: int) -> None:
        """The robot is in the epoch of the last `renew`. Inputs that it repeats are counted by its iterations, since a
        further epoch may come before its first step."""
        if self._again is not None:
            self._taken = {name: (k, value) for name, value in self._again.items()}

    def content(self) -> bool:
        """Return whether the app says after its last step that it has converged, or has hardly moved."""
        said: object = self._call(f"converged() at iteration {self.k}", self.app.converged, "converged")
        if said is not None:
            return bool(said)
        if not self.undecided and type(self.app).converged is not SyncApp.converged:
            self.undecided = True
            self.app.robot.log.warning("%s", UNDECIDED)
        before, after = (_numbers(self.schema.unpack(own)) for own in self._step)
        return all(abs(a - b) <= self._tolerance for a, b in zip(before, after, strict=True))

    def _take_inputs(self, k: int) -> None:
        inputs = {name: self._inputs.pop(name) for name in tuple(self._inputs)}
        if self._again is not None:  # what this epoch has not taken is part of the state with which it began
            inputs, self._again, self._taken = {**self._again, **inputs}, None, {}
        for name, value in inputs.items():
            self._taken[name] = k, value
            setattr(self.app, name, copy.deepcopy(value))  # a step may change what it was given

    def _pack(self, where: str, method: str) -> tuple[bytes, bytes]:
        app, spec = self.app, type(self.app).spec
        try:
            own = self.schema.pack({name: getattr(app, name) for name in self.schema.names})
            private = pack_private({name: getattr(app, name) for name in spec.private if hasattr(app, name)})
        except AppError as error:
            raise self._fault(where, method, str(error)) from None
        bound = app.diverges_above
        # What others see is what we go on with: float32 rounds, numbers become floats, lists tuples.
        for name, value in zip(self.schema.names, self.schema.unpack(own), strict=True):
            if not (abs(value) <= bound if type(value) is float else _within(value, bound)):
                text = f"{name}: {value!r} is beyond diverges_above = {bound:g}: the app diverges"
                raise self._fault(where, method, text)
            object.__setattr__(app, name, _own(value) if name in spec.arrays else value)
        return own, private


def _own(array: Any) -> object:
    """Return a copy of an unpacked array, which may be written to."""
    return array.copy()


def _within(value: object, bound: float) -> bool:
    """Return whether no number of a field's value is beyond a bound."""
    return all(abs(number) <= bound for number in _numbers((value,)))


def _numbers(values: Iterable[object]) -> Iterator[float]:
    """Yield the numbers in field values, nested as they may be."""
    for value in values:
        if isinstance(value, tuple):
            yield from _numbers(value)
        elif isinstance(value, int | float):
            yield value
        elif is_array(value):
            yield from value.ravel().tolist()  # type: ignore[attr-defined]
