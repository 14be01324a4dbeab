"""What an app author may write, and what the platform says when it is wrong."""

import asyncio
import enum
import logging
import math
import re
from collections import deque
from collections.abc import Callable, Sequence
from typing import Annotated, Any, ClassVar

import numpy as np
import pytest

from services.apps.faults import bounded
from services.apps.runner import Runner
from swarm import Array, EventApp, SyncApp, Vector, float32, parameter
from swarm.app.robot import Robot
from swarm.core.graph import Graph
from swarm.errors import AppError
from swarm.messages import AppState, Measurement
from swarm.messages.codec import decode, encode

LINE = Graph.of_shape("line", ["r0", "r1", "r2"])


class Mood(enum.Enum):
    GOOD = 1


class Tracker(SyncApp):
    """One of each."""

    value: float = 2.0
    coarse: float32
    count: int
    on: bool
    place: Annotated[Vector, 2]
    _last: float = 0.5
    _seen: list[int] = []  # noqa: RUF012
    _free: object
    LIMIT = 3
    gain: float = parameter(0.5, unit="1/s", low=0, high=1)
    rounds: int = parameter(3, low=1)
    shout: bool = parameter(False)
    mode: str = parameter("slow", choices=("slow", "fast"))

    def step(self, neighbours: list[Any]) -> None:
        self.value += self.gain


def make(kind: type[SyncApp] = Tracker, name: str = "r1", **values: Any) -> Any:
    return kind(Robot(name, LINE), values)


def run(step: Callable[[Any, list[Any]], Any], kind: type[SyncApp] = Tracker) -> Runner:
    """A runner whose app has `step`, after its start."""
    runner = Runner(type(kind.__name__, (kind,), {"step": step, "__module__": __name__})(Robot("r1", LINE)), __file__)
    runner.start(None)
    return runner


def do_step(runner: Runner, k: int = 0, **neighbours: bytes) -> tuple[bytes, bytes]:
    own = runner.schema.pack(runner.state())
    return runner.step(k, own, neighbours or {"r0": own, "r2": own}, None)


# State


def test_fields_come_from_annotations_in_declared_order_base_first() -> None:
    class Base(SyncApp):
        b: float
        a: float

    class Derived(Base):
        c: int

        def step(self, neighbours: list[Any]) -> None: ...

    assert Derived.spec.schema.names == ("b", "a", "c")
    assert Tracker.spec.schema.names == ("value", "coarse", "count", "on", "place")
    assert Tracker.spec.private == ("_last", "_seen", "_free")
    assert set(Tracker.spec.parameters) == {"weights", "diverges_above", "gain", "rounds", "shout", "mode"}


def test_first_values_come_from_the_class_or_the_configuration() -> None:
    app = make()
    assert (app.value, app.coarse, app.count, app.on, app.place) == (2.0, 0.0, 0, False, (0.0, 0.0))
    app = make(value=3, count=-1, on=True, place=[1, 2])
    assert (app.value, app.count, app.on, app.place) == (3.0, -1, True, (1.0, 2.0))


def test_floods_and_messages_need_a_bus_and_say_so() -> None:
    robot = make().robot
    calls = (lambda: robot.flood(b"x"), lambda: robot.send("r1", b"x"), robot.messages, lambda: robot.answer("t"))
    for call in (*calls, lambda: robot.clock):
        with pytest.raises(AppError, match=r"needs? a bus"):
            call()


def test_defaults_are_not_shared_between_robots() -> None:
    one, two = make(), make()
    one._seen.append(1)
    assert two._seen == []


def test_a_mistyped_name_is_an_error_that_says_how_to_declare() -> None:
    app = make()
    with pytest.raises(AttributeError) as caught:
        app.valeu = 1.0
    text = str(caught.value)
    assert "Tracker declares no 'valeu', it declares value, coarse, count, on, place, _last, _seen, _free" in text
    assert "Is 'value' meant? Else declare it in the class: `valeu: float` is shared" in text
    assert "`_valeu: float` is private" in text


@pytest.mark.parametrize(
    ("value", "shared"),
    [(1, "int"), (True, "bool"), (1.5, "float"), (Mood.GOOD, "Mood"), ({}, None), (np.float64(1), "float")],
)
def test_a_mistyped_name_is_proposed_with_the_type_of_its_value(value: object, shared: str | None) -> None:
    with pytest.raises(AttributeError) as caught:
        make().cuont = value
    text = str(caught.value)
    assert "Is 'count' meant?" in text
    assert text.endswith(
        f"`cuont: {shared}` is shared with the neighbours, `_cuont: {shared}` is private"
        if shared
        else "in the class: `_cuont: dict` is private"
    )


def test_a_parameter_cannot_be_assigned() -> None:
    with pytest.raises(AttributeError, match=r"Tracker.gain is a parameter, a step cannot change it; .*--set gain="):
        make().gain = 1.0


@pytest.mark.parametrize(
    ("body", "message"),
    [
        ({"__annotations__": {"x": list}}, "class Bad: x: a shared field is of type"),
        ({"__annotations__": {"k": int}}, "class Bad: k: this name belongs to the platform"),
        ({"__annotations__": {"name": int}}, "class Bad: name: this name belongs to the platform"),
        ({"__annotations__": {"step": int}}, "class Bad: step: this name belongs to the platform"),
        ({"__annotations__": {"x": "Nothing"}}, "class Bad: an annotation cannot be read: name 'Nothing'"),
        ({"__annotations__": {"lambda": float}}, "class Bad: lambda: a word of the Python language"),
        ({"__annotations__": {"ä": float}}, "class Bad: ä: a shared field's name is of letters a-z"),
        ({"__init__": lambda self: None}, "class Bad: an app has no __init__"),
        ({"plotted": "value"}, "class Bad: plotted: expected names, e.g. (\"x\",), got 'value'"),
        ({"plotted": 5}, "class Bad: plotted: expected names"),
        ({"__annotations__": {"p": list}, "p": parameter(1.0)}, "class Bad: p: a parameter is of type"),
        ({"__annotations__": {"p": int}, "p": parameter(1.5)}, "class Bad: p: default: expected an integer, got 1.5"),
        ({"__annotations__": {"p": float}, "p": parameter(2.0, high=1)}, "expected a finite number of at most 1"),
        (
            {"__annotations__": {"x": float}, "x": np.zeros(2)},
            "class Bad: x: it is declared as float, and is given an arr",
        ),
        ({"__annotations__": {"x": int}, "x": 1.5}, "class Bad: x: expected an integer of 64 bits, got 1.5"),
        ({"__annotations__": {"_x": Array[2]}, "_x": (1.0,)}, "class Bad: _x: expected an array of shape (2,)"),
    ],
)
def test_classes_that_cannot_be_are_refused_when_made(body: dict[str, Any], message: str) -> None:
    with pytest.raises(AppError, match=re.escape(message)):
        type("Bad", (SyncApp,), body)


def test_no_state_and_too_much_state_are_refused() -> None:
    with pytest.raises(AppError, match="Empty shares no state"):
        make(type("Empty", (SyncApp,), {}))
    with pytest.raises(AppError, match=r"shares no state: x has no type: declare `x: float = \.\.\.`"):
        make(type("Untyped", (SyncApp,), {"measured": True, "x": 1.0}))
    with pytest.raises(AppError, match="takes 800 bytes"):
        make(type("Big", (SyncApp,), {"__annotations__": {"x": Annotated[Vector, 100]}}))


@pytest.mark.parametrize(
    ("name", "value", "mend"),
    [
        ("_seen", np.zeros(1), "_seen: Array[1]"),
        ("_seen", [], "_seen: list"),
        ("seen", {}, "_seen: dict"),
        ("seen", deque([1]), "_seen: deque"),
    ],
)
def test_a_value_that_all_robots_of_a_simulation_would_share_is_refused(name: str, value: object, mend: str) -> None:
    mixin = type("Mixin", (), {name: value})
    message = f"{name} has no type, so all robots of a simulation would share it: declare `{mend} = ...`"
    for kind, bases, body in (
        (SyncApp, (SyncApp,), {"__annotations__": {"x": float}, name: value}),
        (SyncApp, (mixin, SyncApp), {"__annotations__": {"x": float}}),
        (EventApp, (EventApp,), {name: value}),
    ):
        with pytest.raises(AppError, match=re.escape(f"class Shared{kind.__name__}: {message}")):
            type(f"Shared{kind.__name__}", bases, body)


def test_constants_and_declared_values_in_a_class_are_no_shared_state() -> None:
    typed = {"x": float, "_seen": list, "names": ClassVar[list[str]]}
    body = {"step": Tracker.step, "_seen": [], "names": [], "_GAINS": [1], "f": (1,), "plotted": ["x"]}
    base = type("Base", (SyncApp,), {"__annotations__": typed, **body})
    fine = type("Fine", (base,), {"names": ["a"], "__slots__": []})
    first, second = make(fine), make(fine)
    first._seen.append(1)
    assert second._seen == []


# Parameters


def test_parameters_of_an_app_get_their_declared_types() -> None:
    app = make(gain=1, rounds=7, shout=True, mode="fast", weights="row")
    assert (app.gain, app.rounds, app.shout, app.mode) == (1.0, 7, True, "fast")
    assert type(app.gain) is float


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("gain", 1.5, "gain: expected a finite number from 0 to 1 in 1/s, got 1.5"),
        ("gain", float("nan"), "gain: expected a finite number"),
        ("gain", "x", "gain: expected a finite number from 0 to 1 in 1/s, got 'x'"),
        ("gain", True, "gain: expected a finite number"),
        ("rounds", 0, "rounds: expected an integer of at least 1, got 0"),
        ("rounds", 2.0, "rounds: expected an integer"),
        ("shout", 1, "shout: expected true or false, got 1"),
        ("mode", "quick", "mode: expected 'slow' or 'fast', got 'quick'"),
        ("weights", "best", "weights: expected 'metropolis' or 'row', got 'best'"),
        ("value", "x", "value: expected a number, got 'x'"),
        ("place", 1.0, "place: expected 2 numbers, got 1.0"),
        (
            "gian",
            1.0,
            "unknown parameter 'gian'; Tracker has weights, diverges_above, gain, rounds, shout, mode, value, coarse",
        ),
        ("_last", 1.0, "unknown parameter '_last'"),
        ("LIMIT", 1, "unknown parameter 'LIMIT'"),
    ],
)
def test_wrong_parameters_say_what_was_expected(name: str, value: object, message: str) -> None:
    with pytest.raises(AppError, match=re.escape(message)):
        make(**{name: value})


# What a step sees


def test_neighbours_are_sorted_named_and_read_only() -> None:
    seen: list[Any] = []
    runner = run(lambda self, neighbours: seen.extend(neighbours) or setattr(self, "value", 1.0))
    pack = runner.schema.pack
    base = runner.state()
    do_step(runner, r2=pack({**base, "value": 2.0}), r0=pack({**base, "value": 0.5, "place": (1.0, 2.0)}))
    assert [n.name for n in seen] == ["r0", "r2"]
    assert [n.value for n in seen] == [0.5, 2.0]
    assert seen[0].place == (1.0, 2.0)
    with pytest.raises(AttributeError):
        seen[0].value = 3.0
    with pytest.raises(AttributeError):
        seen[0].valeu  # noqa: B018


@pytest.mark.parametrize(
    ("weights", "name", "expected", "own"),
    [
        ("metropolis", "r1", {"r0": 1 / 3, "r2": 1 / 3}, 1 / 3),
        ("metropolis", "r0", {"r1": 1 / 3}, 2 / 3),
        ("row", "r1", {"r0": 1 / 3, "r2": 1 / 3}, 1 / 3),
        ("row", "r0", {"r1": 1 / 2}, 1 / 2),
    ],
)
def test_the_robot_has_the_weights_of_its_rule(weights: str, name: str, expected: dict[str, float], own: float) -> None:
    app = make(name=name, weights=weights)
    assert app.robot.weights == pytest.approx(expected)
    assert app.robot.own_weight == pytest.approx(own)
    views = [app.spec.view(n, 0.0, 0.0, 0, False, (0.0, 0.0)) for n in expected]
    assert app.weighted(views) == [(pytest.approx(expected[v.name]), v) for v in views]


def test_the_class_may_choose_its_weights() -> None:
    assert make(type("Row", (Tracker,), {"weights": "row"}), "r0").robot.weights == {"r1": 0.5}


def test_an_app_reads_names_log_and_measurement_of_its_robot() -> None:
    robot = make().robot
    assert (robot.name, robot.neighbours, robot.swarm) == ("r1", ("r0", "r2"), ("r0", "r1", "r2"))
    assert isinstance(robot.log, logging.Logger)
    with pytest.raises(AppError, match="write `measured = True`"):
        robot.measurement  # noqa: B018


def test_random_numbers_repeat_with_the_step_but_not_between_steps_and_robots() -> None:
    drawn: list[float] = []
    runner = run(lambda self, neighbours: drawn.append(self.robot.random.random()))
    for k in (0, 1, 0):
        do_step(runner, k)
    assert drawn[0] == drawn[2] != drawn[1]
    other = make(name="r0").robot
    other.prepare("0", None)
    assert other.random.random() not in drawn


def test_k_is_the_iteration() -> None:
    seen: list[int] = []
    runner = run(lambda self, neighbours: seen.append(self.k))
    do_step(runner, 0)
    do_step(runner, 1)
    assert seen == [0, 1]
    assert runner.app.k == runner.k == 2


def test_the_own_float32_is_rounded_as_the_neighbours_see_it() -> None:
    runner = run(lambda self, neighbours: setattr(self, "coarse", 0.1))
    do_step(runner)
    assert runner.app.coarse == 0.10000000149011612


# Faults of a step

LINE_OF_STEP = r"Tracker on r1, iteration 4: .*test_app_api.py, from line \d+ on: "


@pytest.mark.parametrize(
    ("step", "message"),
    [
        (
            lambda self, n: 1 / 0,
            r"Tracker on r1, iteration 4: .*test_app_api.py, line \d+: ZeroDivisionError: division by zero",
        ),
        (
            lambda self, n: setattr(self, "value", float("nan")),
            LINE_OF_STEP + r"value: nan is not a finite number",
        ),
        (
            lambda self, n: setattr(self, "count", 1.5),
            LINE_OF_STEP + r"count: expected an integer of 64 bits, got 1.5",
        ),
        (lambda self, n: setattr(self, "place", (1.0,)), LINE_OF_STEP + r"place: expected 2 numbers"),
        (lambda self, n: setattr(self, "_last", object()), LINE_OF_STEP + r"_last: .* cannot be saved"),
        (lambda self, n: setattr(self, "valeu", 1), r"iteration 4: .*AttributeError: Tracker declares no 'valeu'"),
        (lambda self, n: self.robot.measurement, r"iteration 4: .*no measurement: write `measured = True`"),
        (lambda self: None, LINE_OF_STEP + r"TypeError: .* takes 1 positional argument"),
        (
            lambda self, n: 5.0,
            r"Tracker on r1, iteration 4: .*, from line \d+ on: it returned 5.0; a step assigns to the state instead",
        ),
    ],
)
def test_a_fault_names_robot_iteration_and_line(step: Callable[[Any, Any], Any], message: str) -> None:
    with pytest.raises(AppError, match=message):
        do_step(run(step), 4)


def test_a_fault_in_start_is_named() -> None:
    kind = type("Start", (Tracker,), {"start": lambda self: 1 / 0})
    with pytest.raises(AppError, match=r"Start on r1, start\(\): .*ZeroDivisionError"):
        Runner(kind(Robot("r1", LINE)), __file__).start(None)


def test_a_missing_step_is_named() -> None:
    kind = type("Lazy", (SyncApp,), {"__annotations__": {"x": float}})
    with pytest.raises(AppError, match=r"class Lazy has no step: add `def step\(self, neighbours\):`"):
        kind(Robot("r1", LINE))


@pytest.mark.parametrize(
    ("result", "message"),
    [
        (lambda self: 3, "expected a dict by name, got 3"),
        (lambda self: {1: 2}, "expected a dict by name"),
        (lambda self: {"x": float("nan")}, "x: expected a finite number, bool, text or vector, got nan"),
        (lambda self: {"x": None}, "x: expected a finite number"),
        (lambda self: {"x": 2**70}, "x: expected a finite number"),
        (lambda self: {"x": [10**400]}, "x: expected a finite number"),
        (lambda self: {"x": 10**5000}, "x: expected a finite number, bool, text or vector, got a int"),
        (lambda self: {"x": (1.0, "a")}, "x: expected a finite number"),
        (lambda self: {}[1], "KeyError: 1"),
    ],
)
def test_wrong_results_are_named(result: Callable[[Any], Any], message: str) -> None:
    runner = Runner(type("Result", (Tracker,), {"result": result})(Robot("r1", LINE)), __file__)
    runner.start(None)
    with pytest.raises(AppError, match=r"Result on r1, result\(\) at iteration 0: .*" + re.escape(message)):
        runner.result()


def test_whatever_a_step_raises_is_the_apps_fault() -> None:
    def step(self: Any, neighbours: Any) -> None:
        raise asyncio.CancelledError

    with pytest.raises(AppError, match="CancelledError"):
        do_step(run(step), 4)


def test_an_error_that_is_not_known_is_left_out_of_what_the_bus_carries() -> None:
    """On a robot the truth is unknown. A message with nan in it is refused as a whole."""
    kind = type("Known", (Tracker,), {"error": lambda self, truth: 0.5})
    runner = Runner(kind(Robot("r1", LINE)), __file__)
    runner.start(None)
    assert math.isnan(runner.result()["error"])
    assert "error" not in runner.known(runner.result())
    decode(AppState, encode(AppState(0.0, 0, runner.state(), runner.known(runner.result()))), "key")


def test_a_fault_with_a_very_long_text_fits_into_a_message() -> None:
    text = bounded(AppError("x" * 100_000))
    assert len(text) == 2000
    assert text.endswith("...")


def test_a_result_keeps_its_names() -> None:
    kind = type("Moody", (Tracker,), {"result": lambda self: {"a": 1} if self.k == 0 else {"b": 1}})
    runner = Runner(kind(Robot("r1", LINE)), __file__)
    runner.start(None)
    assert runner.result() == {"a": 1}
    do_step(runner)
    with pytest.raises(AppError, match="it gave b, first it was a"):
        runner.result()


def grown(numbers: Sequence[float]) -> Callable[[Any], Any]:
    return lambda self: {"a": 1, "h": numbers[: self.k + 1]}


@pytest.mark.parametrize("numbers", [[1.0, 2.0], np.array([1.0, 2.0])])
def test_a_result_keeps_its_shapes(numbers: Any) -> None:
    kind = type("Grown", (Tracker,), {"result": grown(numbers)})
    runner = Runner(kind(Robot("r1", LINE)), __file__)
    runner.start(None)
    assert runner.result() == {"a": 1, "h": (1.0,)}
    do_step(runner)
    line = grown(numbers).__code__.co_firstlineno
    where = f"result() at iteration 1: {__file__}, from line {line} on: "
    with pytest.raises(AppError, match=re.escape(f"{where}its 'h' is of shape (2,), first it was (1,);")):
        runner.result()


def test_a_result_may_be_a_member_of_an_enum_as_a_state_may() -> None:
    kind = type("Choosy", (Tracker,), {"result": lambda self: {"mood": next(iter(Mood))}})
    runner = Runner(kind(Robot("r1", LINE)), __file__)
    runner.start(None)
    assert runner.result() == {"mood": next(iter(Mood)).name}


def test_the_default_result_is_the_shared_state() -> None:
    runner = run(lambda self, n: None)
    assert runner.result() == {"value": 2.0, "coarse": 0.0, "count": 0, "on": False, "place": (0.0, 0.0)}


# Restart


def test_a_restored_app_goes_on_bit_for_bit() -> None:
    def step(self: Any, neighbours: list[Any]) -> None:
        self._last += self.value / 3
        self._seen.append(self.k)
        self.value = self._last + 0.1 * sum(n.value for n in neighbours) + self.robot.random.random()

    whole, broken = run(step), run(step)
    for k in range(4):
        packed = do_step(whole, k)
        again = do_step(broken, k)
        assert packed == again
        broken = run(step)
        broken.restore(k + 1, *again, broken.app.robot.graph)
        assert broken.result() == whole.result()
        assert broken.app._seen == list(range(k + 1))


def test_measurements_reach_start_and_step() -> None:
    seen: list[int] = []
    kind = type(
        "Measured",
        (Tracker,),
        {
            "measured": True,
            "start": lambda self: seen.append(self.robot.measurement.sequence),
            "step": lambda self, n: seen.append(self.robot.measurement.sequence),
        },
    )
    runner = Runner(kind(Robot("r1", LINE)), __file__)
    runner.start(Measurement(0.0, 0, 1.0, 0.0, 0.0))
    own = runner.schema.pack(runner.state())
    runner.step(0, own, {}, Measurement(0.0, 7, 1.0, 0.0, 0.0))
    assert seen == [0, 7]
