"""Gains and model against numpy, and the physics against both."""

import math
import re
from pathlib import Path

import numpy as np
import pytest
from balancer_rig import CONFIGURED, OTHER, PLANTS
from hypothesis import given
from hypothesis import strategies as st

from services.balancer.core.control import lqr
from services.balancer.core.control.body import body_model
from services.balancer.core.control.estimation.estimator import SPEED_TIME_S
from sim.core.balboa import STEP_S, BalboaBody
from swarm.config.types import Body
from swarm.errors import LocalError

BARE = Body(payload=0.0, payload_height=0.0)
"""The robot as sold, without Pi and UWB module: what published figures refer to."""


def poles(body: Body) -> list[float]:
    a, _ = lqr.linear_model(body_model("zero2w", body))
    return sorted(np.linalg.eigvals(np.array(a)).real)


def test_open_loop_poles_of_the_bare_robot() -> None:
    """The open-loop model agrees with the time constant that Pololu found by experiment (140 ms)."""
    assert poles(BARE) == pytest.approx([-55.6, -5.22, 0.0, 7.23], abs=0.1)


def test_the_page_of_the_simulation_has_the_poles_of_the_bare_and_of_the_whole_robot() -> None:
    page = (Path(__file__).parents[5] / "docs/reference/simulation.md").read_text()
    told = re.findall(r"0, (\S+), (\S+) and (\S+) per second", page)
    assert [sorted(map(float, (0, *each))) for each in told] == [
        pytest.approx(poles(body), abs=0.05) for body in (BARE, Body())
    ]


def test_the_payload_lifts_the_centre_of_mass() -> None:
    bare, zero, four = body_model("zero2w", BARE), CONFIGURED, body_model("pi4", Body())
    assert zero.lever - bare.lever == pytest.approx(0.0065, abs=0.0015)
    assert bare.mass < zero.mass < four.mass
    assert bare.lever < zero.lever < four.lever


def test_gearing_trades_torque_for_speed() -> None:
    body = body_model("zero2w", Body(gear_ratio=51.45 * 41 / 25))
    assert body.stall_torque / (7.4 / 6) == pytest.approx(2 * 0.107, abs=1e-3)
    assert body.free_speed / (7.4 / 6) == pytest.approx(41.5, abs=0.1)
    assert body.counts_per_turn == pytest.approx(1012.5, abs=0.2)


@given(st.lists(st.lists(st.floats(-50, 50), min_size=4, max_size=4), min_size=4, max_size=4))
def test_matrix_exponential_against_eigenvalues(rows: list[list[float]]) -> None:
    a = [[value / 10 for value in row] for row in rows]
    result = np.array(lqr.exponential(a))
    assert np.linalg.det(result) == pytest.approx(math.exp(np.trace(np.array(a))), rel=1e-6, abs=1e-9)
    half = np.array(lqr.exponential([[value / 2 for value in row] for row in a]))
    assert half @ half == pytest.approx(result, rel=1e-9, abs=1e-9 * max(1.0, abs(result).max()))


@given(st.lists(st.lists(st.floats(-9, 9), min_size=3, max_size=3), min_size=3, max_size=3))
def test_the_inverse_equals_that_of_numpy(rows: list[list[float]]) -> None:
    matrix = np.array(rows) + 40 * np.eye(3)
    assert np.array(lqr.inverse(matrix.tolist())) == pytest.approx(np.linalg.inv(matrix), rel=1e-9, abs=1e-12)


def test_a_singular_matrix_is_named() -> None:
    with pytest.raises(LocalError, match="singular"):
        lqr.inverse([[1.0, 2.0], [2.0, 4.0]])


def test_the_delayed_step_is_the_one_of_fine_steps() -> None:
    a, b = lqr.linear_model(CONFIGURED)
    phi, before, after = map(np.array, lqr.delayed(a, b, 0.01, 0.004))
    fine, gain = map(np.array, lqr.discretize(a, b, 0.001))
    state = np.array([[0.1], [0.2], [0.05], [0.3]])
    expected = state
    for step in range(10):
        expected = fine @ expected + gain * (0.7 if step < 4 else -0.2)
    assert phi @ state + before * 0.7 + after * -0.2 == pytest.approx(expected, rel=1e-9)


def test_riccati_by_doubling_is_the_fixed_point_of_its_iteration() -> None:
    a, before, after = map(np.array, lqr.delayed(*lqr.linear_model(CONFIGURED), 0.01, 0.005))
    f = np.block([[a, before], [np.zeros((1, 5))]])
    g = np.vstack([after, [[1.0]]])
    q, r = np.diag([*lqr.Q, 1e-6]), np.array([[lqr.R]])
    p = np.array(lqr.dare(f.tolist(), g.tolist(), q.tolist(), r.tolist()))
    gain = np.linalg.solve(r + g.T @ p @ g, g.T @ p @ f)
    assert f.T @ p @ (f - g @ gain) + q == pytest.approx(p, rel=1e-8)
    oracle = q
    for _ in range(6000):
        oracle = f.T @ oracle @ (f - g @ np.linalg.solve(r + g.T @ oracle @ g, g.T @ oracle @ f)) + q
    assert p == pytest.approx(oracle, rel=1e-7)
    assert lqr.gains(CONFIGURED) == pytest.approx(tuple(-gain[0]), rel=1e-9)


def test_a_body_without_motors_has_no_gains() -> None:
    with pytest.raises(LocalError, match=r"\[body\]"):
        lqr.dare([[2.0]], [[0.0]], [[1.0]], [[1.0]])


def _radius(plant: object, delay: float) -> float:
    """Largest eigenvalue of the closed loop: gains of the configured body, speed from filtered differences."""
    k = lqr.gains(CONFIGURED)
    whole, part = int(delay / lqr.PERIOD_S), delay % lqr.PERIOD_S
    a, before, after = map(np.array, lqr.delayed(*lqr.linear_model(plant), lqr.PERIOD_S, part))
    weight = lqr.PERIOD_S / (SPEED_TIME_S + lqr.PERIOD_S)
    size = 7 + whole  # z, last x, filtered speed, last commands
    unit = np.eye(size)
    speed = (1 - weight) * unit[5] + weight / lqr.PERIOD_S * (unit[0] - unit[4])
    command = k[0] * unit[0] + k[1] * speed + k[2] * unit[2] + k[3] * unit[3] + k[4] * unit[6]
    commands = [command, *unit[6:]]
    step = np.zeros((size, size))
    step[:4, :4] = a
    step[:4] += np.outer(after[:, 0], commands[whole]) + np.outer(before[:, 0], commands[whole + 1])
    step[4], step[5] = unit[0], speed
    step[6:] = commands[: 1 + whole]
    return float(max(abs(np.linalg.eigvals(step))))


@pytest.mark.parametrize("delay", [0.001, 0.0035, 0.007, 0.0101, 0.015, 0.02001, 0.03001])
def test_gains_bear_delay_and_wrong_bodies(delay: float) -> None:
    assert max(_radius(plant, delay) for plant in PLANTS.values()) < 0.992


@pytest.mark.parametrize("plant", [CONFIGURED, OTHER])
def test_the_physics_is_the_model_near_upright(plant: object) -> None:
    frictionless = type(plant)(**{**{f: getattr(plant, f) for f in plant.__dataclass_fields__}, "friction": 0.0})
    a, b = map(np.array, lqr.discretize(*lqr.linear_model(plant), 0.1))
    body = BalboaBody(frictionless, 0.0, tilt=0.002, held=False)
    body.drive(0.004, 0.004)
    body.advance(0.1 + STEP_S / 2)
    x, speed, tilt, rate = (a @ np.array([0, 0, 0.002, 0]) + b[:, 0] * 0.004).tolist()
    assert body.travel == pytest.approx(x, rel=0.05)
    assert body.speed == pytest.approx(speed, rel=0.05)
    assert body.tilt == pytest.approx(tilt, abs=1e-4)  # of a tilt that came from 2e-3
    assert body.tilt_rate == pytest.approx(rate, rel=0.05)
