"""State feedback for the balancer: linear model of the body, discretized, and the regulator from a Riccati equation.

    M [x''; th''] = [tau / r; m g l th - tau],   tau = ts (u - (x'/r - th') / w0)          (upright, small angles)

with x the axle's position and th the tilt. The gains minimize the sum of z'Qz + u'Ru at 100 Hz when each command takes
effect half a period after its sample: what the bus and the computation take, with some lateness. Plain Python: the
matrices are 5 x 5, and the loop's process shall not carry numpy.
"""

import math
from functools import cache
from operator import mul

from services.balancer.core.control.body import GRAVITY, BodyModel
from swarm.errors import LocalError

Matrix = list[list[float]]

PERIOD_S = 0.01

DELAY_S = 0.005
"""Seconds from the IMU's sample to the motors' answer. 3.5 ms of it are the Pi's bus; the rest is lateness."""

Q = (300.0, 2.0, 200.0, 1.0)
"""Weights of x (m), x' (m/s), th (rad), th' (rad/s)."""
R = 200.0
"""Weight of the duty. With these the loop is stable, speed filter included, for delays of 1 to 30 ms on both estimates
of the body and each of their parameters 20 % up or down (docs/explanation/balancing.md, section Gains: smaller R is
not)."""


def linear_model(body: BodyModel) -> tuple[Matrix, Matrix]:
    """Continuous A (4 x 4) and B (4 x 1) of z = (x, x', th, th') about upright, u = duty of both motors."""
    r = body.wheel_radius
    coupling = body.mass * body.lever - body.rotor_inertia / r
    m11 = body.mass + body.wheel_mass + (body.wheel_inertia + body.rotor_inertia) / r**2
    m22 = body.inertia + body.mass * body.lever**2 + body.rotor_inertia
    determinant = m11 * m22 - coupling**2
    if determinant <= 0:
        raise LocalError(f"no such body: its mass matrix is not positive ({body})")
    damping = body.stall_torque / body.free_speed
    # Accelerations for a unit of torque and for a unit of tilt.
    x_torque, th_torque = (m22 / r + coupling) / determinant, -(m11 + coupling / r) / determinant
    weight = body.mass * GRAVITY * body.lever
    x_tilt, th_tilt = -coupling * weight / determinant, m11 * weight / determinant
    a = [
        [0.0, 1.0, 0.0, 0.0],
        [0.0, -x_torque * damping / r, x_tilt, x_torque * damping],
        [0.0, 0.0, 0.0, 1.0],
        [0.0, -th_torque * damping / r, th_tilt, th_torque * damping],
    ]
    b = [[0.0], [x_torque * body.stall_torque], [0.0], [th_torque * body.stall_torque]]
    return a, b


def feed_forward(body: BodyModel) -> tuple[float, float, float]:
    """Return the feed-forward of steady motion: duty per speed (1/(m/s)), tilt (rad) and duty per acceleration
    (1/(m/s^2)).

    From the model above with th'' = 0: the lean that holds an acceleration, and the torque that holds the lean.
    """
    a, b = linear_model(body)
    duty_per_tilt = -a[3][2] / b[3][0]
    tilt = 1.0 / (a[1][2] + b[1][0] * duty_per_tilt)
    return 1.0 / (body.wheel_radius * body.free_speed), tilt, tilt * duty_per_tilt


@cache  # the robots of a simulation mostly have the same body
def gains(body: BodyModel) -> tuple[float, ...]:
    """Feedback (k_x, k_v, k_th, k_rate, k_u): u = k . (x, x', th, th', previous u)."""
    a, before, after = delayed(*linear_model(body), PERIOD_S, DELAY_S)
    size = len(a)
    whole_a = [[*row, *last] for row, last in zip(a, before, strict=True)] + [[0.0] * (size + 1)]
    whole_b = [*after, [1.0]]
    # The last command must cost a little as a state too, or the doubling below would meet a singular weight.
    weights = diagonal((*Q, 1e-6))
    solution = dare(whole_a, whole_b, weights, [[R]])
    pb = multiply(solution, whole_b)
    scale = R + multiply(transpose(whole_b), pb)[0][0]
    row = multiply(transpose(pb), whole_a)[0]
    return tuple(-value / scale for value in row)


def discretize(a: Matrix, b: Matrix, period: float) -> tuple[Matrix, Matrix]:
    """Exact step response with the input held over `period`: expm of the block matrix [[A, B], [0, 0]]."""
    size, inputs = len(a), len(b[0])
    block = [[*(period * v for v in ra), *(period * v for v in rb)] for ra, rb in zip(a, b, strict=True)]
    block += [[0.0] * (size + inputs) for _ in range(inputs)]
    whole = exponential(block)
    return [row[:size] for row in whole[:size]], [row[size:] for row in whole[:size]]


def delayed(a: Matrix, b: Matrix, period: float, delay: float) -> tuple[Matrix, Matrix, Matrix]:
    """Step of one period with an input that changes `delay` after its start: A, and B of the input before and after.

    z(k+1) = A z(k) + B_before u(k-1) + B_after u(k); 0 < delay < period.
    """
    rest, after = discretize(a, b, period - delay)
    first, before = discretize(a, b, delay)
    return multiply(rest, first), multiply(rest, before), after


def exponential(a: Matrix) -> Matrix:
    """Matrix exponential by scaling, Taylor series and squaring."""
    norm = max(math.fsum(abs(value) for value in row) for row in a)
    squarings = max(0, math.ceil(math.log2(norm)) + 3) if norm > 0 else 0
    scaled = [[value / 2**squarings for value in row] for row in a]
    term = result = identity(len(a))
    for order in range(1, 20):  # norm <= 1/8: the last term is below 1e-33
        term = [[value / order for value in row] for row in multiply(term, scaled)]
        result = add(result, term)
    for _ in range(squarings):
        result = multiply(result, result)
    return result


def dare(a: Matrix, b: Matrix, q: Matrix, r: Matrix) -> Matrix:
    """Solve P = A'PA - A'PB (R + B'PB)^-1 B'PA + Q by structured doubling (Chu, Fan, Lin, Wang 2004, SDA).

    Each step doubles the horizon, so that some ten suffice. Raises `LocalError` where no regulator exists.
    """
    g = multiply(multiply(b, inverse(r)), transpose(b))
    h = q
    for _ in range(40):
        w = inverse(add(identity(len(a)), multiply(g, h)))
        wa, wg = multiply(w, a), multiply(w, g)
        step = multiply(multiply(transpose(a), h), wa)
        g = add(g, multiply(multiply(a, wg), transpose(a)))
        a, h = multiply(a, wa), add(h, step)
        change = max(abs(value) for row in step for value in row)
        size = max(abs(value) for row in h for value in row)
        if not math.isfinite(size):
            break
        if change <= 1e-13 * size:
            return h
    raise LocalError("no balancing gains exist for the configured body: check [body]")


def identity(size: int) -> Matrix:
    return diagonal((1.0,) * size)


def diagonal(values: tuple[float, ...]) -> Matrix:
    """Matrix with `values` on its diagonal."""
    return [[value if i == j else 0.0 for j in range(len(values))] for i, value in enumerate(values)]


def transpose(a: Matrix) -> Matrix:
    return [list(column) for column in zip(*a, strict=True)]


def add(a: Matrix, b: Matrix) -> Matrix:
    return [[x + y for x, y in zip(ra, rb, strict=True)] for ra, rb in zip(a, b, strict=True)]


def multiply(a: Matrix, b: Matrix) -> Matrix:
    """Return the product A B."""
    columns = list(zip(*b, strict=True))
    return [[math.fsum(map(mul, row, column)) for column in columns] for row in a]


def inverse(a: Matrix) -> Matrix:
    """Return A^-1 by Gauss-Jordan elimination with row pivots. Raises `LocalError` where A is singular."""
    size = len(a)
    rows = [[*row, *unit] for row, unit in zip(a, identity(size), strict=True)]
    for column in range(size):
        pivot = max(range(column, size), key=lambda i: abs(rows[i][column]))
        if rows[pivot][column] == 0.0:
            raise LocalError("a singular matrix has no inverse")
        rows[column], rows[pivot] = rows[pivot], rows[column]
        head = rows[column] = [value / rows[column][column] for value in rows[column]]
        for i in range(size):
            factor = rows[i][column]
            if i != column and factor != 0.0:
                rows[i] = [value - factor * top for value, top in zip(rows[i], head, strict=True)]
    return [row[size:] for row in rows]
