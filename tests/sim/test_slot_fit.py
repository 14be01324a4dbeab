"""The fit of the slot radio's parameters: on paces that are known, within the bounds that it tells."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim.slots.fitting import Curve, fitted

VALUES = (0.04, 0.08, 0.15, 0.25, 0.4)


def curve(truth: float, power: float, noise: float = 1.0) -> Curve:
    """A run whose pace goes with a power of the parameter; two seeds around it."""
    return Curve(
        0.9 * truth**power, {value: [0.9 * value**power * noise, 0.9 * value**power / noise] for value in VALUES}
    )


@given(st.floats(0.041, 0.39), st.lists(st.floats(0.3, 2.0), min_size=1, max_size=4))
def test_what_made_the_paces_is_found_and_lies_within_the_bounds(truth: float, powers: list[float]) -> None:
    found = fitted([curve(truth, power, 1.05) for power in powers])
    assert found.value == pytest.approx(truth, rel=0.01)
    assert found.low <= truth * 1.01
    assert truth <= found.high * 1.01
    assert found.factor < 1.01


def test_runs_that_contradict_each_other_have_a_factor_that_says_so() -> None:
    found = fitted([curve(0.1, 1.0), curve(0.2, 1.0)])
    assert found.value == pytest.approx((0.1 * 0.2) ** 0.5, rel=0.02)
    assert found.factor == pytest.approx(2**0.5, rel=0.02)


@pytest.mark.parametrize(("truth", "edge"), [(0.01, 0.04), (4.0, 0.4)])
def test_beyond_what_was_simulated_the_edge_is_found(truth: float, edge: float) -> None:
    found = fitted([curve(truth, 1.0)])
    assert found.value == pytest.approx(edge)
    assert edge in (pytest.approx(found.low), pytest.approx(found.high))
