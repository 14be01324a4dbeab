import math

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from services.dwm.core.estimation import multilateration
from services.dwm.core.estimation.multilateration import Fix, NoFix, degenerate, multilaterate

TABLE = [(0.0, 0.0, 0.0), (1.94, 0.0, 0.0), (1.0, 1.94, 0.0), (0.5, 1.0, 0.0)]
METRES = st.floats(-3, 5)


def ranges(anchors, x, y, z=0.0):
    return [math.dist(anchor, (x, y, z)) for anchor in anchors]


@given(METRES, METRES)
def test_exact_ranges_give_the_place(x, y):
    fix = multilaterate(TABLE, ranges(TABLE, x, y), 0.0, 0.04)
    assert isinstance(fix, Fix)
    assert math.hypot(fix.x - x, fix.y - y) < 1e-3
    assert max(map(abs, fix.residuals)) < 1e-3
    assert set(fix.weights) == {1.0}


@example(x=0, y=1, height=1, heights=[1, 1, 3, 1])  # beside a local minimum of the error
@given(METRES, METRES, st.floats(0, 1.5), st.lists(st.floats(0.5, 3), min_size=4, max_size=4))
def test_anchors_at_heights_of_their_own(x, y, height, heights):
    anchors = [(ax, ay, az) for (ax, ay, _), az in zip(TABLE, heights, strict=True)]
    fix = multilaterate(anchors, ranges(anchors, x, y, height), height, 0.04)
    assert isinstance(fix, Fix)
    assert math.hypot(fix.x - x, fix.y - y) < 1e-2


def test_one_range_that_is_far_too_long_moves_the_place_little():
    wide = [(0.0, 0.0, 0.0), (4.0, 0.0, 0.0), (4.0, 4.0, 0.0), (0.0, 4.0, 0.0), (2.0, 4.0, 0.0), (2.0, 0.0, 0.0)]
    measured = ranges(wide, 1.5, 2.5)
    measured[2] += 1.0
    fix = multilaterate(wide, measured, 0.0, 0.04)
    assert math.hypot(fix.x - 1.5, fix.y - 2.5) < 0.06  # least squares without weights: 0.3 m
    assert fix.weights[2] == 0.0
    assert fix.residuals[2] == pytest.approx(1.0, abs=0.1)


@pytest.mark.parametrize("blocked", [0, 2, 3])  # without the second the others lie in a line
def test_of_four_ranges_one_without_line_of_sight_is_given_up(blocked):
    measured = ranges(TABLE, 1.2, 0.6)
    measured[blocked] += 0.8
    fix = multilaterate(TABLE, measured, 0.0, 0.04)
    assert math.hypot(fix.x - 1.2, fix.y - 0.6) < 0.01
    assert fix.weights[blocked] == 0.0
    assert fix.residuals[blocked] == pytest.approx(0.8, abs=0.01)


@pytest.mark.parametrize(("excess", "searches"), [(0.0, 1), (0.08, 1), (0.8, 5)])
def test_no_range_is_left_out_in_turn_where_all_agree(monkeypatch, excess, searches):
    searched = []
    search = multilateration._solve
    monkeypatch.setattr(multilateration, "_solve", lambda *problem: searched.append(problem) or search(*problem))
    measured = ranges(TABLE, 1.2, 0.6)
    measured[0] += excess
    assert isinstance(multilaterate(TABLE, measured, 0.0, 0.04), Fix)
    assert len(searched) == searches


def test_the_covariance_is_that_of_the_geometry():
    fix = multilaterate(TABLE, ranges(TABLE, 1.0, 1.0), 0.0, 0.04)
    # straight from the definition: sigma^2 (H'H)^-1 with H the unit vectors from the anchors
    units = [((1 - x) / math.hypot(1 - x, 1 - y), (1 - y) / math.hypot(1 - x, 1 - y)) for x, y, _ in TABLE]
    xx, xy, yy = (sum(u[i] * u[j] for u in units) for i, j in ((0, 0), (0, 1), (1, 1)))
    determinant = xx * yy - xy * xy
    assert fix.covariance == pytest.approx(tuple(0.04**2 / determinant * value for value in (yy, -xy, xx)), rel=1e-6)


@pytest.mark.parametrize(
    ("anchors", "words"),
    [
        ([], "0 ranges, three are needed"),
        (TABLE[:2], "2 ranges, three are needed"),
        ([(0.0, 0.0, 0.0), (1.0, 1.0, 0.0), (2.0, 2.0, 0.0)], "lie in a line"),
        ([(0.0, 0.0, 0.0), (1.0, 0.0, 2.0), (2.0, 0.01, 0.0), (3.0, 0.0, 1.0)], "lie in a line"),
        ([(1.0, 1.0, 0.0)] * 3, "at one place"),
    ],
)
def test_geometry_that_gives_no_place_is_named(anchors, words):
    answer = multilaterate(anchors, ranges(anchors, 0.5, 0.7), 0.0, 0.04)
    assert isinstance(answer, NoFix)
    assert words in answer.reason


def test_anchors_far_away_in_one_direction():
    answer = multilaterate(TABLE, ranges(TABLE, 500.0, 1.0), 0.0, 0.04)
    assert isinstance(answer, NoFix)
    assert "one direction" in answer.reason


@given(
    st.lists(st.tuples(METRES, METRES, METRES), min_size=0, max_size=6),
    st.lists(st.floats(0, 100), min_size=6, max_size=6),
)
def test_whatever_the_ranges_there_is_an_answer(anchors, measured):
    answer = multilaterate(anchors, measured[: len(anchors)], 0.0, 0.04)
    assert isinstance(answer, Fix | NoFix)
    if isinstance(answer, Fix):
        assert all(map(math.isfinite, (answer.x, answer.y, *answer.covariance)))


@given(st.floats(-3, 3), st.floats(0.01, 1.0), st.floats(0, math.pi))
def test_a_line_is_a_line_in_any_direction(offset, step, angle):
    c, s = math.cos(angle), math.sin(angle)
    anchors = [(offset + i * step * c, i * step * s, 0.0) for i in range(4)]
    assert degenerate(anchors) is not None
    assert degenerate([*anchors, (offset - step * s, step * c, 0.0)]) is None
