import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.dwm.core.estimation import filters
from services.dwm.core.estimation.filters import ORIGINAL_PERCENTILES, PlaceFilter, RangeFilter

VALUES = st.lists(st.floats(-100, 100), min_size=1, max_size=60)


@given(VALUES, st.floats(0, 100))
def test_percentiles_are_those_of_numpy(values, percent):
    assert filters.interpolated_percentile(values, percent) == pytest.approx(np.percentile(values, percent), abs=1e-9)


def test_bounds_are_a_quartile_range_and_a_half_beyond_the_quartiles():
    # eq. 2.1; quartiles of 0..8 are 2 and 6
    assert filters.bounds(range(9)) == (2 - 1.5 * 4, 6 + 1.5 * 4)
    assert filters.bounds(range(11), ORIGINAL_PERCENTILES) == (4 - 1.5 * 2, 6 + 1.5 * 2)


def test_outliers_go_and_the_rest_keeps_its_order():
    assert filters.inliers([3.0, 1.0, 2.0, 60.0, 2.5, -60.0]) == [3.0, 1.0, 2.0, 2.5]
    assert filters.inliers([1.0, 1.0, 50.0]) == [1.0, 1.0, 50.0]  # of three nothing can be told


def test_places_have_an_upper_bound_alone():
    ring = [(1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0)] * 3
    middle = [(0.0, 0.0)]  # as unlike the others as can be, and yet nearer to the centroid
    assert filters.inlying_places(ring + middle + [(9.0, 0.0)]) == ring + middle


def test_the_recursive_average_of_the_original_program():
    # in place: the second mean enters the third in place of the second value
    assert filters.recursive_average([1.0, 3.0, 5.0], 2) == [1.0, 2.0, 3.5]
    assert filters.recursive_average([1.0, 3.0, 5.0], 1) == [1.0, 3.0, 5.0]


@given(st.integers(1, 30), VALUES)
def test_range_filter_is_the_mean_of_the_windows_inliers(window, values):
    smooth = RangeFilter(window)
    for index, value in enumerate(values):
        part = filters.inliers(values[max(0, index + 1 - window) : index + 1])
        assert smooth.add(value) == pytest.approx(sum(part) / len(part), abs=1e-9)


@given(st.integers(1, 20), st.lists(st.tuples(st.floats(-9, 9), st.floats(-9, 9)), min_size=1, max_size=40))
def test_place_filter_stays_within_what_it_was_given(window, places):
    smooth = PlaceFilter(window)
    for index, place in enumerate(places):
        x, y = smooth.add(*place)
        part = places[max(0, index + 1 - window) : index + 1]
        assert min(p[0] for p in part) - 1e-9 <= x <= max(p[0] for p in part) + 1e-9
        assert min(p[1] for p in part) - 1e-9 <= y <= max(p[1] for p in part) + 1e-9


def test_a_cleared_filter_forgets_its_values():
    smooth, place = RangeFilter(5), PlaceFilter(5)
    smooth.add(1.0)
    smooth.clear()
    place.add(1.0, 1.0)
    place.clear()
    assert smooth.add(3.0) == 3.0
    assert place.add(3.0, 4.0) == (3.0, 4.0)
