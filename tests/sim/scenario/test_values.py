"""What a program gives as first values: for all robots, by list, by robot, as lists or as numpy arrays."""

from typing import Annotated, Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim.scenario.values import settings_from_values
from swarm import Array, Matrix, SyncApp, Vector, parameter
from swarm.app.settings import Setting, parse
from swarm.errors import AppError

NUMBERS = st.floats(allow_nan=False, allow_infinity=False)


class Fields(SyncApp):
    a: float
    v: Annotated[Vector, 2]
    x: Array[2]
    m: Annotated[Matrix, 2, 2]
    gain: float = parameter(1.0)

    def step(self, neighbours: list[Any]) -> None:
        pass


@st.composite
def swarms(draw: st.DrawFn) -> tuple[list[str], list[list[float]]]:
    """Robots' names, and two numbers for each."""
    count = draw(st.integers(1, 6))
    pairs = draw(st.lists(st.lists(NUMBERS, min_size=2, max_size=2), min_size=count, max_size=count))
    return [f"r{index}" for index in range(count)], pairs


@given(swarms())
def test_a_list_a_map_by_robot_and_a_map_of_robots_say_the_same(swarm: tuple[list[str], list[list[float]]]) -> None:
    robots, pairs = swarm
    for name in ("v", "x"):
        by_list = settings_from_values(Fields, {name: pairs}, robots)
        assert by_list == [Setting(robot, name, tuple(pair)) for robot, pair in zip(robots, pairs, strict=True)]
        assert settings_from_values(Fields, {name: np.array(pairs)}, robots) == by_list
        assert settings_from_values(Fields, {name: dict(zip(robots, pairs, strict=True))}, robots) == by_list
        by_robot = {robot: {name: pair} for robot, pair in zip(robots, pairs, strict=True)}
        assert settings_from_values(Fields, by_robot, robots) == by_list


@given(swarms())
def test_a_setting_says_the_same_on_a_command_line(swarm: tuple[list[str], list[list[float]]]) -> None:
    robots, pairs = swarm
    given_values = {"a": [pair[0] for pair in pairs], "x": pairs, "gain": pairs[0][1]}
    for setting in settings_from_values(Fields, given_values, robots):
        assert parse(setting.text) == setting


def test_one_value_is_for_all_robots_whatever_its_shape() -> None:
    values = {"a": np.float64(2.0), "v": (1, 2), "x": np.array([3.0, 4.0]), "m": [[1, 2], [3, 4]], "gain": True}
    found = settings_from_values(Fields, values, ["r0", "r1"])
    assert found == [
        Setting(None, "a", 2.0), Setting(None, "v", (1.0, 2.0)), Setting(None, "x", (3.0, 4.0)),
        Setting(None, "m", (1.0, 2.0, 3.0, 4.0)), Setting(None, "gain", True),
    ]  # fmt: skip


@pytest.mark.parametrize("wrong", [{"a": [1.0] * 3}, {"x": [[1.0, 2.0]] * 3}, {"x": 3 * [1.0]}, {"a": []}])
def test_a_list_that_has_not_one_entry_for_each_robot_is_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(AppError, match=r"values: [ax]: expected one value.* or one for each of 2 robots; got shape"):
        settings_from_values(Fields, wrong, ["r0", "r1"])
