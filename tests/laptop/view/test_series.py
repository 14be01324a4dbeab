"""Numbers for charts: of whatever robots have told, a chart gets numbers or nothing."""

import json
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from laptop.view.series import MOST, MOST_IN_ALL, dig, most_of, rows, wanted
from swarm.errors import LocalError

NAMES = st.sampled_from(["x", "peer", "links", "0", "1", "k"])
VALUES: st.SearchStrategy[Any] = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=3),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(NAMES, inner, max_size=3),
    max_leaves=8,
)


FIELDS = st.lists(st.lists(NAMES, min_size=1, max_size=3).map(tuple), min_size=1, max_size=3)


@given(st.lists(st.tuples(st.floats(0, 9), VALUES), max_size=5), FIELDS)
def test_rows_hold_numbers_that_json_has_whatever_a_robot_says(samples: Any, fields: Any) -> None:
    found = rows(samples, fields)
    json.dumps(found, allow_nan=False)
    assert all(len(row) == 2 + len(fields) and any(each is not None for each in row[2:]) for row in found)


def test_parts_of_a_list_are_called_by_their_peer_and_else_by_their_place() -> None:
    links = {"links": [{"peer": "r1", "rtt": 0.1}, {"peer": "r2", "rtt": 0.2}], "lines": ["a", "b"]}
    assert dig(links, ("links", "r2", "rtt")) == 0.2
    assert dig(links, ("links", "0", "rtt")) == 0.1
    assert dig(links, ("lines", "1")) == "b"
    assert dig(links, ("lines", "2")) is None
    assert rows([(3.0, {"k": 7, **links})], [("links", "r1", "rtt"), ("nothing",)]) == [[3.0, 7, 0.1, None]]


def test_truth_values_are_drawn_as_numbers_and_texts_are_not() -> None:
    assert rows([(1.0, {"on": True, "mode": "REST"}), (2.0, {"on": False})], [("on",), ("mode",)]) == [
        [1.0, None, 1, None], [2.0, None, 0, None],
    ]  # fmt: skip


@given(st.integers(0, 10_000))
def test_a_chart_of_many_robots_has_few_points_of_each(robots: int) -> None:
    assert 20 <= most_of(robots) <= MOST
    assert most_of(robots) * robots <= max(MOST_IN_ALL, 20 * robots)


@pytest.mark.parametrize(
    "asked", [{"topic": "x", "fields": []}, {"topic": "x", "fields": [[]]}, {"topic": "x", "fields": [["a"]] * 9}]
)
def test_fields_without_bound_are_refused(asked: Any) -> None:
    with pytest.raises(LocalError, match="expected 1 to"):
        wanted(asked)
