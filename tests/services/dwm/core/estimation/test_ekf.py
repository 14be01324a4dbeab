import math
import random

import numpy as np
import pytest
from conftest import costly
from hypothesis import given
from hypothesis import strategies as st

from services.dwm.core.estimation.ekf import BIAS, GATE, GYRO, HEADING, PATIENCE, SCALE, Ekf, EkfNoise
from swarm.core.linear import cholesky

ANCHORS = [(0.0, 0.0, 0.0), (1.94, 0.0, 0.5), (1.0, 1.94, 0.0), (0.5, 1.0, 1.0)]
NOISE = EkfNoise()


def make(place=(1.2, 0.7), heading=0.3, deviation=0.5):
    return Ekf(ANCHORS, 0.1, place, heading, deviation, NOISE)


def warmed(seed=1):
    """A filter whose covariance is full."""
    generator = random.Random(seed)
    ekf = make()
    for _ in range(20):
        ekf.predict(generator.uniform(-0.02, 0.05), generator.gauss(0, 0.1), 0.04)
        for anchor in range(4):
            distance = math.dist((ekf.state[0], ekf.state[1], 0.1), ANCHORS[anchor])
            ekf.update(anchor, distance + generator.gauss(0, 0.03), (0.01, -0.02))
    return ekf


def moved(state, distance, turn, dt):
    middle = state[HEADING] + 0.5 * (turn - state[GYRO] * dt)
    out = np.array(state)
    out[0] += (1 + state[SCALE]) * distance * math.cos(middle)
    out[1] += (1 + state[SCALE]) * distance * math.sin(middle)
    out[HEADING] += turn - state[GYRO] * dt
    return out


def jacobian(function, state):
    columns = []
    for i in range(len(state)):
        step = np.zeros(len(state))
        step[i] = 1e-6
        columns.append((np.atleast_1d(function(state + step)) - np.atleast_1d(function(state - step))) / 2e-6)
    return np.array(columns).T


def test_prediction_propagates_the_covariance_by_the_jacobian():
    ekf = warmed()
    state, before = np.array(ekf.state), np.array(ekf.covariance)
    distance, turn, dt = 0.03, 0.0, 0.04
    f = jacobian(lambda s: moved(s, distance, turn, dt), state)
    f[0:2, GYRO] = 0.0  # half a step's turn by the gyro's bias is left out: 1e-5 m
    ekf.predict(distance, turn, dt)
    assert ekf.state == pytest.approx(moved(state, distance, turn, dt).tolist())
    added = np.array(ekf.covariance) - f @ before @ f.T
    c, s = math.cos(state[HEADING]), math.sin(state[HEADING])
    along = NOISE.along**2 * dt + (NOISE.along_share * distance) ** 2
    turned = np.array([[c, -s], [s, c]]) @ np.diag([along, NOISE.across**2 * dt]) @ np.array([[c, s], [-s, c]])
    expected = np.zeros_like(added)
    expected[:2, :2] = turned
    diagonal = [NOISE.turn**2 * dt + (NOISE.turn_share * distance) ** 2, NOISE.gyro**2 * dt, NOISE.scale**2 * dt]
    expected[range(2, 5), range(2, 5)] = diagonal
    expected[range(BIAS, 9), range(BIAS, 9)] = NOISE.bias**2 * dt
    assert np.abs(added - expected).max() < 2e-7


def test_an_update_is_that_of_the_textbook():
    ekf = warmed()
    state, before = np.array(ekf.state), np.array(ekf.covariance)
    shift = np.array([0.03, -0.01])

    def expected_range(s):
        turned = s[HEADING] - state[HEADING]
        c, sn = math.cos(turned), math.sin(turned)
        place = s[:2] + np.array([[c, -sn], [sn, c]]) @ shift
        return math.dist((*place, 0.1), ANCHORS[1]) + s[BIAS + 1]

    h = jacobian(expected_range, state)[0]
    measured = expected_range(state) + 0.05
    variance = h @ before @ h + NOISE.range**2
    gain = before @ h / variance
    told = ekf.update(1, measured, tuple(shift))
    assert told.accepted
    assert told.error == pytest.approx(0.05)
    assert told.variance == pytest.approx(variance, rel=1e-4)  # and the curvature, which is little here
    assert ekf.state == pytest.approx((state + gain * 0.05).tolist(), abs=1e-5)
    assert np.allclose(ekf.covariance, before - np.outer(gain, gain) * variance, atol=1e-7)


@costly(50)
@given(st.integers(0, 1000), st.lists(st.tuples(st.integers(0, 3), st.floats(0, 10)), max_size=60))
def test_the_covariance_stays_one(seed, measured):
    ekf = warmed(seed)
    for anchor, distance in measured:
        ekf.predict(0.01, 0.05, 0.04)
        ekf.update(anchor, distance)
        assert np.allclose(ekf.covariance, np.transpose(ekf.covariance), rtol=0, atol=1e-14)
        cholesky(ekf.covariance)
        assert -math.pi <= ekf.state[HEADING] <= math.pi


def test_a_range_beyond_the_gate_changes_nothing_and_the_thirteenth_is_taken():
    ekf = warmed()
    expected = math.dist((*ekf.state[:2], 0.1), ANCHORS[0]) + ekf.state[BIAS]
    state = list(ekf.state)
    for count in range(PATIENCE):
        told = ekf.update(0, expected + 1.0)
        assert not told.accepted
        assert told.error**2 > GATE * told.variance
        assert ekf.rejected[0] == count + 1
    assert ekf.state == state
    assert ekf.update(0, expected + 1.0).accepted
    assert ekf.rejected[0] == 0
    assert ekf.state != state


def test_an_accepted_range_ends_the_count():
    ekf = warmed()
    expected = math.dist((*ekf.state[:2], 0.1), ANCHORS[0]) + ekf.state[BIAS]
    ekf.update(0, expected + 1.0)
    ekf.update(0, expected)
    assert ekf.rejected[0] == 0


def test_near_an_anchor_its_range_counts_less():
    filters = [Ekf([(0.0, 0.0, 0.0)], 0.0, (x, 0.0), 0.0, 0.5, NOISE) for x in (0.2, 2.0)]
    near, far = (ekf.update(0, ekf.state[0]).variance for ekf in filters)
    assert near - far == pytest.approx((0.2**2 / 0.4) ** 2 - (0.2**2 / 4.0) ** 2)  # P / (2 r), squared


def test_a_copy_goes_its_own_way():
    ekf = warmed()
    twin = ekf.copy()
    twin.predict(0.1, 0.0, 0.1)
    twin.set_heading(1.0, 0.1)
    assert twin.state[HEADING] == 1.0
    assert twin.covariance[HEADING][HEADING] == pytest.approx(0.01)
    assert ekf.state != twin.state
    assert ekf.covariance != twin.covariance
