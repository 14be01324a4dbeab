import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from swarm.core.linear import SingularError, least_squares, solve

SEEDS = st.integers(0, 10_000)


@given(SEEDS, st.integers(1, 6))
def test_least_squares_agrees_with_numpy(seed, size):
    generator = np.random.default_rng(seed)
    rows = generator.normal(size=(size + 4, size))
    right = generator.normal(size=size + 4)
    expected = np.linalg.lstsq(rows, right, rcond=None)[0]
    assert least_squares(rows.tolist(), right.tolist()) == pytest.approx(expected.tolist(), abs=1e-7)
    normal = rows.T @ rows
    assert solve(normal.tolist(), right[:size].tolist()) == pytest.approx(
        np.linalg.solve(normal, right[:size]).tolist(), abs=1e-7
    )


def test_columns_of_very_different_size():
    rows = [[1.0, 1e3 * x, 1e-3 * x * x] for x in (1.0, 2.0, 3.0, 4.0)]
    assert least_squares(rows, [row[0] + row[1] + row[2] for row in rows]) == pytest.approx([1.0, 1.0, 1.0], rel=1e-6)


@pytest.mark.parametrize("rows", [[[1.0, 2.0], [2.0, 4.0], [3.0, 6.0]], [[1.0, 2.0]], [], [[0.0], [0.0]]])
def test_what_is_not_determined_is_said(rows):
    with pytest.raises(SingularError):
        least_squares(rows, [1.0] * len(rows))
