"""Places handed on from neighbour to neighbour: the newest of each robot wins, and ages are right."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.apps.core.places import AHEAD_S, COLUMNS, EMPTY, FORGET_S, ROWS, Places, Row


def test_a_line_hands_places_on_with_their_age() -> None:
    """Robots 0 to 4 in line, 0.1 s between their steps: four hops later robot 4 knows where 0 was 0.4 s ago."""
    robots = [Places(i, 5) for i in range(5)]
    rows = [robot.tell(0.0) for robot in robots]
    for step in range(1, 20):
        now = step * 0.1
        for i, robot in enumerate(robots):
            robot.be((float(i) + 0.2 * now, 0.0), (0.2, 0.0), 0.0, now)
            for j in (i - 1, i + 1):
                if 0 <= j < 5:
                    robot.hear(rows[j], 0.1, now)
        rows = [robot.tell(now) for robot in robots]
    news = {int(row[0]): row for row in rows[4] if row[0] >= 0}
    assert sorted(news) == [0, 1, 2, 3, 4]
    assert rows[4][0][0] == 4.0, "the own one first"
    assert news[0][5] == pytest.approx(0.4)
    # Carried on with its velocity the place is right all the same.
    assert robots[4].others(now)[0] == pytest.approx((0.2 * now, 0.0))


def test_of_two_the_newer_counts_whoever_tells_it() -> None:
    places = Places(0, 60)
    places.hear([(3.0, 1.0, 1.0, 0.0, 0.0, 0.5)], 0.1, 10.0)
    places.hear([(3.0, 2.0, 2.0, 0.0, 0.0, 2.0)], 0.0, 10.0)
    assert places.others(10.0) == {3: (1.0, 1.0)}
    places.hear([(3.0, 2.0, 2.0, 0.0, 0.0, 0.1)], 0.0, 10.0)
    assert places.others(10.0) == {3: (2.0, 2.0)}


def test_news_of_oneself_is_no_news_and_old_ones_are_forgotten() -> None:
    places = Places(0, 60)
    places.hear([(0.0, 9.0, 9.0, 0.0, 0.0, 0.0), (2.0, 1.0, 0.0, 0.5, 0.0, 0.0), EMPTY], 0.0, 0.0)
    assert places.tell(0.0)[0][:3] == (2.0, 1.0, 0.0)
    assert places.others(20.0) == {2: pytest.approx((1.0 + 0.5 * AHEAD_S, 0.0))}
    assert places.others(FORGET_S + 1.0) == {}


@given(
    st.lists(st.tuples(st.integers(-2, 40), *[st.floats(-1e3, 1e3)] * 4, st.floats(-5.0, 50.0)), max_size=60),
    st.booleans(),
)
def test_whatever_is_heard_a_message_has_its_size_and_each_robot_once(rows, known: bool) -> None:
    places = Places(1, 60)
    if known:
        places.be((0.0, 0.0), (0.0, 0.0), 0.05, 100.0)
    places.hear([tuple(map(float, row)) for row in rows], 0.0, 100.0)
    told = places.tell(100.0)
    assert (len(told), {len(row) for row in told}) == (ROWS, {COLUMNS})
    numbers = [row[0] for row in told if row[0] >= 0]
    assert len(set(numbers)) == len(numbers)
    assert not known or numbers[0] == 1.0
    assert all(row[5] >= 0.0 for row in told)


@pytest.mark.parametrize(
    "row",
    [
        (math.nan, 1.0, 1.0, 0.0, 0.0, 0.0),
        (math.inf, 1.0, 1.0, 0.0, 0.0, 0.0),
        (3.0, 1.0, 1.0, 0.0, 0.0, 0.0),
        (-1.0, 1.0, 1.0, 0.0, 0.0, 0.0),
        (1.0, math.nan, 1.0, 0.0, 0.0, 0.0),
        (1.0, 1.0, 1.0, 0.0, math.inf, 0.0),
        (1.0, 1.0, 1.0, 0.0, 0.0, math.nan),
    ],
)
def test_what_cannot_be_a_place_is_not_told_on(row: Row) -> None:
    places = Places(0, 3)
    places.hear([row], 0.0, 10.0)
    assert places.others(10.0) == {}
    assert set(places.tell(10.0)) == {EMPTY}
