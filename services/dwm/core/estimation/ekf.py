"""Extended Kalman filter of a robot's pose from wheel odometry, gyro and UWB ranges.

State: x, y (m), heading (rad), gyro bias (rad/s), odometry scale error, and for each anchor the bias of its ranges
(m): the place and the robot's own antenna give every range an error that no averaging removes.

    predict   x += (1 + s) d cos(psi),  y += (1 + s) d sin(psi),  psi += turn - b_g dt
    update    range_i = |p - a_i| + b_i, anchor after anchor, R = (4.5 cm)^2

(Thrun, Burgard, Fox, "Probabilistic Robotics", 2005, chapters 3 and 7.) A range whose innovation nu has nu^2 / S
above 6.63 (chi-square, 1 degree of freedom, 99 %) is rejected: no line of sight makes ranges wrong by decimetres.
After 12 rejections in a row of one anchor the next is accepted all the same, or a filter that is wrong itself would
never find back.

Pure Python with the zeros of the Jacobians left out: a robot has no numpy.
"""

from collections.abc import Sequence
from math import cos, pi, sin, sqrt
from typing import NamedTuple

from swarm.frozen import frozen

X, Y, HEADING, GYRO, SCALE, BIAS = range(6)
"""Indices in the state; the bias of anchor i is at BIAS + i."""

GATE = 6.63
"""chi-square quantile, 1 degree of freedom, 99 %."""

PATIENCE = 12
"""Number of ranges to one anchor that are rejected in a row. The next one is accepted."""

Point = tuple[float, float, float]


@frozen
class EkfNoise:
    """The assumed standard deviations of motion and ranges."""

    along: float = 0.005
    """Deviation along the way at any speed, m / sqrt(s): slip, and sway while standing."""
    along_share: float = 0.03
    """Deviation along the way, as a share of its length."""
    across: float = 0.003
    """Deviation across the way, m / sqrt(s)."""
    turn: float = 0.003
    """Deviation of the heading, rad / sqrt(s)."""
    turn_share: float = 0.02
    """Deviation of the heading for each metre of the way, rad / m."""
    gyro: float = 2e-4
    """Drift of the gyro's zero, rad/s / sqrt(s)."""
    scale: float = 1e-4
    """Drift of the odometry's scale, 1 / sqrt(s)."""
    bias: float = 0.002
    """Drift of an anchor's bias, m / sqrt(s): it changes with place and orientation."""
    range: float = 0.045
    """Deviation of a calibrated range in line of sight, m."""
    start_place: float = 0.2
    """m."""
    start_gyro: float = 0.01
    """rad/s."""
    start_scale: float = 0.03
    start_bias: float = 0.03
    """m."""


class Innovation(NamedTuple):
    """The innovation of one range."""

    anchor: int
    error: float
    """Measured minus expected range, m."""
    variance: float
    """Variance of `error` that the filter expected, m^2."""
    accepted: bool


class Ekf:
    """The filter; anchors are (x, y, z) in m and are spoken of by their index."""

    def __init__(
        self,
        anchors: Sequence[Point],
        height: float,
        place: tuple[float, float],
        heading: float,
        heading_deviation: float,
        noise: EkfNoise,
    ) -> None:
        size = BIAS + len(anchors)
        self._anchors = tuple(anchors)
        self._height = height
        self._noise = noise
        self.state = [*place, heading] + [0.0] * (size - 3)
        start = (
            noise.start_place,
            noise.start_place,
            heading_deviation,
            noise.start_gyro,
            noise.start_scale,
            *[noise.start_bias] * len(anchors),
        )
        self.covariance = [[deviation**2 if i == j else 0.0 for j in range(size)] for i, deviation in enumerate(start)]
        self.rejected = [0] * len(anchors)

    def copy(self) -> "Ekf":
        """Return a copy of the filter, which is independent of this one."""
        twin = object.__new__(Ekf)
        twin._anchors, twin._height, twin._noise = self._anchors, self._height, self._noise
        twin.state = list(self.state)
        twin.covariance = [list(row) for row in self.covariance]
        twin.rejected = list(self.rejected)
        return twin

    def predict(self, distance: float, turn: float, dt: float) -> None:
        """Move: `distance` rolled forward (m) and `turn` made (rad, counter-clockwise) in the last `dt` s."""
        state, noise = self.state, self._noise
        step = (1.0 + state[SCALE]) * distance
        middle = state[HEADING] + 0.5 * (turn - state[GYRO] * dt)
        c, s = cos(middle), sin(middle)
        state[X] += step * c
        state[Y] += step * s
        state[HEADING] = _wrapped(state[HEADING] + turn - state[GYRO] * dt)
        self._propagate(-step * s, distance * c, step * c, distance * s, dt)
        along = noise.along**2 * dt + (noise.along_share * distance) ** 2
        across = noise.across**2 * dt
        p = self.covariance
        p[X][X] += along * c * c + across * s * s
        p[Y][Y] += along * s * s + across * c * c
        mixed = (along - across) * s * c
        p[X][Y] += mixed
        p[Y][X] += mixed
        p[HEADING][HEADING] += noise.turn**2 * dt + (noise.turn_share * distance) ** 2
        p[GYRO][GYRO] += noise.gyro**2 * dt
        p[SCALE][SCALE] += noise.scale**2 * dt
        drift = noise.bias**2 * dt
        for i in range(BIAS, len(state)):
            p[i][i] += drift

    def _propagate(self, x_heading: float, x_scale: float, y_heading: float, y_scale: float, dt: float) -> None:
        """P = F P F', F the identity but for these four entries and d psi / d b_g = -dt."""
        p = self.covariance
        px, py, ph, pg, ps = p[X], p[Y], p[HEADING], p[GYRO], p[SCALE]
        for j in range(len(px)):
            h, scale = ph[j], ps[j]
            px[j] += x_heading * h + x_scale * scale
            py[j] += y_heading * h + y_scale * scale
            ph[j] = h - dt * pg[j]
        for row in p:
            h, scale = row[HEADING], row[SCALE]
            row[X] += x_heading * h + x_scale * scale
            row[Y] += y_heading * h + y_scale * scale
            row[HEADING] = h - dt * row[GYRO]

    def spread(self, variance: float) -> None:
        """Add `variance` (m^2) to the place in each direction: motion that is not known."""
        self.covariance[X][X] += variance
        self.covariance[Y][Y] += variance

    def set_heading(self, heading: float, deviation: float) -> None:
        """Begin with a heading (rad) that nothing else depends on yet."""
        self.state[HEADING] = _wrapped(heading)
        for row in self.covariance:
            row[HEADING] = 0.0
        self.covariance[HEADING] = [0.0] * len(self.state)
        self.covariance[HEADING][HEADING] = deviation**2

    def update(self, anchor: int, measured: float, shift: tuple[float, float] = (0.0, 0.0)) -> Innovation:
        """Take a range (m) that was measured `shift` (m, world frame) away from the state's place.

        The shift is where the tag was then, because the report is late, and because it leans with the body; it turns
        with the heading.
        """
        state, p = self.state, self.covariance
        ax, ay, az = self._anchors[anchor]
        dx, dy, dz = state[X] + shift[0] - ax, state[Y] + shift[1] - ay, self._height - az
        flat = dx * dx + dy * dy
        distance = sqrt(flat + dz * dz) or 1e-9
        hx, hy = dx / distance, dy / distance
        hh = hy * shift[0] - hx * shift[1]  # turning by dpsi moves the shift by (-shift_y, shift_x) dpsi
        at = BIAS + anchor
        gain = [row[X] * hx + row[Y] * hy + row[HEADING] * hh + row[at] for row in p]
        # The range is no linear function of the place: near an anchor the spread across the line of sight adds to it.
        across = (p[X][X] * dy * dy - 2.0 * p[X][Y] * dx * dy + p[Y][Y] * dx * dx) / (flat or 1e-9)
        curved = 0.5 * across / distance
        variance = gain[X] * hx + gain[Y] * hy + gain[HEADING] * hh + gain[at] + self._noise.range**2 + curved * curved
        error = measured - distance - state[at]
        if error * error > GATE * variance and self.rejected[anchor] < PATIENCE:
            self.rejected[anchor] += 1
            return Innovation(anchor, error, variance, False)
        self.rejected[anchor] = 0
        share = error / variance
        for i, value in enumerate(gain):
            state[i] += value * share
            row, part = p[i], value / variance
            for j in range(i + 1):
                row[j] -= part * gain[j]
                p[j][i] = row[j]
        state[HEADING] = _wrapped(state[HEADING])
        return Innovation(anchor, error, variance, True)


def _wrapped(angle: float) -> float:
    """Return the angle, rad, as a value from -pi to pi."""
    return (angle + pi) % (2.0 * pi) - pi
