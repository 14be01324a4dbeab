import math

from hypothesis import given
from hypothesis import strategies as st

from swarm.core.percentile import percentile


def test_percentiles_are_nearest_rank():
    assert math.isnan(percentile([], 95))
    assert percentile([1.0], 95) == 1.0
    assert percentile(list(map(float, range(1, 101))), 95) == 95.0
    assert percentile(list(map(float, range(1, 101))), 99) == 99.0


@given(st.lists(st.floats(0.0, 10.0), min_size=1), st.floats(1.0, 100.0))
def test_a_percentile_is_one_of_the_values_that_its_share_does_not_exceed(values, percent):
    found = percentile(values, percent)
    assert found in values
    assert sum(value <= found for value in values) >= percent / 100 * len(values)
