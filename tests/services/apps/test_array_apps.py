"""Apps whose state is arrays: arithmetic as one writes it, the same bits everywhere, mends with the author's line."""

from math import fsum
from typing import Annotated, Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.apps.loader import of_class
from services.apps.runner import Runner
from sim.rehearsal import examine
from swarm import Array, EventApp, Matrix, PeriodicApp, SyncApp, Vector, float32, parameter, rehearse, simulate, sweep
from swarm.app.robot import Robot
from swarm.core.graph import Graph
from swarm.errors import AppError

LINE = Graph.of_shape("line", ["r0", "r1", "r2"])


class Filter(SyncApp):
    """A vector, a matrix and private arrays."""

    x: Array[2]
    P: Array[2, 2] = np.eye(2)
    coarse: Array[2, float32]
    _count: Array[2]
    _history: object = np.zeros(3)

    def step(self, neighbours: list[Any]) -> None:
        self.x += sum(w * (n.x - self.x) for w, n in self.weighted(neighbours))
        self.P = self.mix("P") @ self.P / 1.5
        self.coarse += np.float32(0.1)
        self._count += 1
        self._history = np.roll(self._history, 1) + self.x[0]

    def result(self) -> dict[str, Any]:
        return {"norm": np.linalg.norm(self.x), "x": self.x, "wide": self.P, "many": self._count[0] > 2}


STARTS = np.arange(6.0).reshape(3, 2)


def runner(kind: type[SyncApp], name: str = "r1") -> Runner:
    return Runner(kind(Robot(name, LINE)), __file__)


def test_arithmetic_with_the_neighbours_arrays_is_written_as_it_is_meant() -> None:
    swarm = rehearse(Filter, robots=3, topology="full", values={"x": STARTS})
    swarm.run(30)
    assert swarm.result("r0")["x"] == pytest.approx((2.0, 3.0))
    assert swarm.result("r0")["norm"] == pytest.approx(np.hypot(2.0, 3.0))
    assert swarm.result("r0")["many"] is True
    assert len(swarm.result("r0")["wide"]) == 4  # type: ignore[arg-type]


def test_comparisons_and_rows_of_arrays_are_states_and_results_as_they_stand() -> None:
    class Compares(SyncApp):
        x: Array[2] = np.array([1.0, 2.0])
        large: bool
        limit: float = parameter(np.sqrt(2.25), low=0)

        def step(self, neighbours: list[Any]) -> None:
            self.large = self.x[1] > self.limit

        def result(self) -> dict[str, Any]:
            return {"rows": [self.x, 2 * self.x], "mixed": [[1, np.int64(2)], [np.float32(3), 4]], "one": [self.x[0]]}

    run = simulate(Compares, robots=2, iterations=1, values={"limit": np.float64(1.75)})
    assert run["large"].tolist() == [[False, False], [True, True]]
    assert run["rows"][1, 0].tolist() == [[1.0, 2.0], [2.0, 4.0]]
    assert run["mixed"][1, 0].tolist() == [[1.0, 2.0], [3.0, 4.0]]
    assert run["one"].shape == (2, 2, 1)


def test_a_sweep_takes_arrays_and_nested_lists() -> None:
    table = sweep(Filter, {"P": [np.eye(2), [[2.0, 0.0], [0.0, 2.0]]]}, robots=2, iterations=1, progress=False)
    assert [row["P"] for row in table.rows] == ["[[1.0,0.0],[0.0,1.0]]", "[[2.0,0.0],[0.0,2.0]]"]
    assert not any(row["failed"] for row in table.rows)


def test_a_run_has_the_shapes_that_the_class_declares() -> None:
    run = simulate(Filter, robots=3, values={"x": STARTS}, iterations=4)
    assert run["x"].shape == (5, 3, 2)
    assert run["P"].shape == (5, 3, 2, 2)
    assert run["P"][0, 1].tolist() == [[1.0, 0.0], [0.0, 1.0]]
    assert run["coarse"][1, 0, 0] == float(np.float32(0.1))


def test_a_killed_robot_goes_on_with_its_arrays_to_the_bit() -> None:
    plain = runner(Filter)
    own, private = plain.start(None)
    other = plain.schema.pack({"x": [5.0, 7.0], "P": np.full((2, 2), 0.3), "coarse": [0.0, 0.0]})
    for k in range(6):
        if k == 3:
            again = runner(Filter)
            again.restore(k, own, private, LINE)
            own_again, private_again = own, private
        if k >= 3:
            own_again, private_again = again.step(k, own_again, {"r0": other, "r2": other}, None)
        own, private = plain.step(k, own, {"r0": other, "r2": other}, None)
    assert (own_again, private_again) == (own, private)


def test_neighbours_arrays_are_read_only_and_an_assigned_one_is_a_copy() -> None:
    class Copies(SyncApp):
        x: Array[2]

        def step(self, neighbours: list[Any]) -> None:
            self.x = neighbours[0].x
            self.x += 1.0
            assert neighbours[0].x.tolist() == [0.0, 0.0]
            neighbours[0].x[0] = 3.0

    made = runner(Copies)
    own, _ = made.start(None)
    with pytest.raises(AppError, match=r"test_array_apps.py, line \d+: ValueError: .* is read-only"):
        made.step(0, own, {"r0": own, "r2": own}, None)


class Mixes(SyncApp):
    """All that can be mixed, and what cannot."""

    a: float
    b: float32
    v: Annotated[Vector, 2]
    m: Annotated[Matrix, 2, 2]
    x: Array[2]
    n: int

    def step(self, neighbours: list[Any]) -> None:
        pass


NUMBERS = st.floats(-1e6, 1e6)


@given(st.lists(st.tuples(NUMBERS, NUMBERS), min_size=3, max_size=3))
def test_mix_is_the_weighted_sum_to_the_bit_for_floats_tuples_and_arrays(pairs: list[tuple[float, float]]) -> None:
    found: dict[str, Any] = {}

    class Once(Mixes):
        def step(self, neighbours: list[Any]) -> None:
            found.update({name: self.mix(name) for name in "abvmx"})
            found["written"] = self.a + fsum(w * (n.a - self.a) for w, n in self.weighted(neighbours))
            found["array"] = self.x + sum(w * (n.x - self.x) for w, n in self.weighted(neighbours))

    made = runner(Once)
    states = [
        made.schema.pack({"a": x, "b": 1.0, "v": (x, y), "m": ((x, y), (y, x)), "x": [x, y], "n": 0}) for x, y in pairs
    ]
    made.step(0, states[1], {"r0": states[0], "r2": states[2]}, None)
    assert found["a"] == found["written"]
    assert found["b"] == 1.0
    assert found["v"][0] == found["a"]
    assert found["m"][1] == found["v"][::-1]
    assert found["x"].tolist() == found["array"].tolist()
    assert found["x"] == pytest.approx(np.array(found["v"]), abs=1e-9 + 1e-9 * np.abs(np.array(pairs)).max())


def test_mix_refuses_what_is_not_of_floats_and_names_the_fields() -> None:
    app = Mixes(Robot("r1", LINE))
    for name in ("n", "z"):
        with pytest.raises(AppError, match=rf"mix\('{name}'\): expected a shared field of floats; there are a \("):
            app.mix(name)


def test_periodic_apps_mix_with_the_neighbours_they_know() -> None:
    class Agree(PeriodicApp):
        x: Array[2]
        period = 0.1

        def step(self, neighbours: list[Any]) -> None:
            self.x = self.mix("x")

    run = simulate(Agree, robots=3, topology="full", values={"x": STARTS}, seconds=5.0)
    assert np.nanmax(np.abs(run["x"][40] - [2.0, 3.0])) < 0.2


def test_a_step_knows_the_time_since_the_one_before() -> None:
    class Clocked(SyncApp):
        dt: float

        def step(self, neighbours: list[Any]) -> None:
            self.dt = self.robot.dt

    run = simulate(Clocked, robots=3, iterations=20, jitter=0.01)
    assert run["dt"][1].tolist() == [0.0] * 3
    assert np.allclose(run["dt"][2:], np.diff(run.times[1:], axis=0))
    found = list(examine.examine(examine.Task(of_class(Clocked), iterations=5)))
    assert not [finding.fault for finding in found if finding.fault]  # an input of the step, no look at a clock


def _tuples(self: Any, neighbours: Any) -> None:
    self.v = self.v + fsum(1.0 for _ in neighbours) * (neighbours[0].v - self.v)


def _doubles(self: Any, neighbours: Any) -> None:
    self.v = 2 * self.v


def _undeclared(self: Any, neighbours: Any) -> None:
    self.P = np.eye(3)


def _array_as_float(self: Any, neighbours: Any) -> None:
    self.a = np.zeros(2)


def _other_shape(self: Any, neighbours: Any) -> None:
    self.x = np.zeros(3)


def _of_a_neighbour(self: Any, neighbours: Any) -> None:
    neighbours[0].x += 1.0


def _misspelled(self: Any, neighbours: Any) -> None:
    self.robot.led(red=True)


@pytest.mark.parametrize(
    ("step", "mend"),
    [
        (_of_a_neighbour, "read-only .a neighbour's array cannot be changed"),
        (_misspelled, "no attribute 'led' .is 'leds' meant"),
        (_tuples, r"v is a tuple, which cannot compute: declare `v: Array\[2\]`"),
        (_doubles, r"v: expected 2 entries, got 4.* for arithmetic declare `v: Array\[2\]`"),
        (_undeclared, r"declares no 'P'.*`P: Array\[3, 3\]` is shared.*`_P: Array\[3, 3\]` is private"),
        (_array_as_float, r"a: it is declared as float.*declare `a: Array\[2\]`"),
        (_other_shape, r"x: expected an array of shape \(2,\), got shape \(3,\)"),
    ],
)
def test_a_mistake_with_arrays_is_told_with_its_mend_and_the_authors_line(step: Any, mend: str) -> None:
    made = runner(type("Wrong", (Mixes,), {"step": step, "__module__": __name__}))
    own, _ = made.start(None)
    line = step.__code__.co_firstlineno + 1
    with pytest.raises(AppError, match=rf"test_array_apps.py, line {line}: .*{mend}"):
        made.step(0, own, {"r0": own, "r2": own}, None)


class Forgotten(SyncApp):
    x: float

    def steps(self, neighbours: list[Any]) -> None:
        self.x = 1.0


class Idle(PeriodicApp):
    x: float


@pytest.mark.parametrize(("kind", "has"), [(Forgotten, "; it has steps"), (Idle, "$")])
def test_a_missing_step_is_told_with_the_classs_line(kind: type[Any], has: str) -> None:
    with pytest.raises(AppError, match=rf"test_array_apps.py, line \d+: class {kind.__name__} has no step: .*{has}"):
        simulate(kind, robots=2)


def test_an_event_app_needs_no_step() -> None:
    class Quiet(EventApp):
        x: Array[2]

    assert simulate(Quiet, robots=2, seconds=1.0)["x"].shape[2] == 2
