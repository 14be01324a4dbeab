"""Squared-range statistics of a target: what one range says, what many say together, and the place that fits.

A range phi measured at place p says about the target x, with |x|^2 = z taken as a third unknown y = (x, y,
z),

    a'y = b,   a = (-2 p_x, -2 p_y, 1),   b = phi^2 - |p|^2,   weight w = 1 / (4 phi^2 s^2),

where s is the standard deviation of phi including that of the own place, and 2 phi s therefore that of b. The
nine numbers w a a' (upper triangle) and w b a add up over robots and ranges. The solution

    min y'My - 2 v'y   subject to   x^2 + y^2 = z

is Beck, Stoica, Li, "Exact and approximate solutions of source localization problems" (IEEE Trans. Signal
Processing 56, 2008): (M + lam D) y = v - lam f with one root lam, found by bisection. Plain Python: it runs
on a robot at every report.
"""

import math

from swarm.frozen import frozen

Statistics = tuple[float, ...]
"""M11 M12 M13 M22 M23 M33 v1 v2 v3; per robot, or the mean over robots. Units: M11 1/m^2, M13 1/m^3, M33
1/m^4."""

NOTHING: Statistics = (0.0,) * 9

SHORTEST = 0.05
"""Ranges below this, m, get the weight of this one: 1/phi^2 would let one robot at the target outvote all."""

SMALLEST_SPREAD = 1e-3
"""Places within this, m, are one place: their ranges are one circle."""

DECIDED = 9.0
"""A second candidate is ruled out when its sum of squares is larger by this: three standard deviations."""

_ROUNDING = 1e-3
"""Share of the larger spread of the places by which the smaller one may be negative: what rounding of float32 does."""

_BISECTIONS = 200  # at most; it ends when floats do, after some 60


@frozen
class TargetEstimate:
    """The target's place as the ranges tell it."""

    x: float
    """m."""
    y: float
    other: tuple[float, float] | None
    """The second place that fits as well, within `DECIDED`; None where there is none."""
    rank: int
    """3: three places not in line; 2: places in line, two candidates; 1: one place, `x`, `y` is the centre of
    a circle."""
    covariance: tuple[float, float, float]
    """xx, xy and yy of the error, m^2; no larger than the mean range in any direction that the ranges leave open."""

    @property
    def sigma(self) -> float:
        """Standard deviation of the place, sqrt of the trace of its covariance, m."""
        return math.sqrt(self.covariance[0] + self.covariance[2])

    @property
    def ambiguous(self) -> bool:
        """Whether more than one place fits."""
        return self.rank == 1 or self.other is not None


def statistics(distance: float, x: float, y: float, sigma: float) -> Statistics:
    """Return the statistics of one range, m, at the place (x, y). `sigma`: standard deviation of range and own place
    together, m."""
    weight = 1.0 / (4.0 * max(distance, SHORTEST) ** 2 * sigma**2)
    a, c = -2.0 * x, -2.0 * y
    b = distance**2 - x * x - y * y
    return (
        weight * a * a,
        weight * a * c,
        weight * a,
        weight * c * c,
        weight * c,
        weight,
        weight * b * a,
        weight * b * c,
        weight * b,
    )


def solve(s: Statistics, robots: int) -> TargetEstimate | None:
    """Return the place that fits best. `s` is the mean over `robots` robots. None where no range came in yet, and where
    `s` is no sum of ranges: what consensus tracks can be of negative weight while ranges change quickly."""
    m11, m12, m13, m22, m23, w, v1, v2, v3 = s
    if w <= 0.0:
        return None
    # Origin to the weighted mean of the places: M13 and M23 vanish, and z is known from lam alone.
    cx, cy = -m13 / (2 * w), -m23 / (2 * w)
    s11, s12, s22 = m11 - m13 * m13 / w, m12 - m13 * m23 / w, m22 - m23 * m23 / w
    r1 = v1 - s11 * cx - s12 * cy + 2 * cx * v3
    r2 = v2 - s12 * cx - s22 * cy + 2 * cy * v3
    v3 += w * (cx * cx + cy * cy)
    # Axes to those of the spread of the places: u along the longer one, h across it.
    angle = 0.5 * math.atan2(2 * s12, s11 - s22)
    cos, sin = math.cos(angle), math.sin(angle)
    mean, half = (s11 + s22) / 2, math.hypot((s11 - s22) / 2, s12)
    if half - mean > max(_ROUNDING * abs(mean + half), 4 * w * SMALLEST_SPREAD**2):
        return None
    big, small = mean + half, max(mean - half, 0.0)
    along, across = cos * r1 + sin * r2, cos * r2 - sin * r1
    if math.sqrt(max(big, 0.0) / (4 * w)) < SMALLEST_SPREAD:
        half = max(v3 / w, 0.0) / 2
        return TargetEstimate(cx, cy, None, 1, (half, 0.0, half))
    if math.sqrt(small / (4 * w)) < SMALLEST_SPREAD:
        small, across = 0.0, 0.0  # in line but for rounding: nothing tells the two sides apart
    problem = _Problem(big, small, along, across, w, v3)
    u, h = problem.best()
    other = problem.second(u, h)
    if other is not None and robots * (problem.cost(*other) - problem.cost(u, h)) >= DECIDED:
        other = None
    # Fisher information of the place, from the same sums: 4 w (x - p)(x - p)' = unit vectors / s^2.
    i11, i22, i12 = big + 4 * w * u * u, small + 4 * w * h * h, 4 * w * u * h
    determinant = i11 * i22 - i12 * i12
    widest = (u * u + h * h + (big + small) / (4 * w)) / 2
    covariance = (widest, 0.0, widest)
    if determinant > 0.0 and (i11 + i22) / (robots * determinant) < 2 * widest:
        covariance = tuple([part / (robots * determinant) for part in _turned(i22, -i12, i11, cos, sin)])  # type: ignore[assignment]

    def back(u: float, h: float) -> tuple[float, float]:
        return cx + cos * u - sin * h, cy + sin * u + cos * h

    x, y = back(u, h)
    return TargetEstimate(x, y, None if other is None else back(*other), 3 if small > 0.0 else 2, covariance)


def _turned(uu: float, uh: float, hh: float, cos: float, sin: float) -> tuple[float, float, float]:
    """Rotate a symmetric matrix from the axes u, h to x, y."""
    return (
        cos * cos * uu - 2 * cos * sin * uh + sin * sin * hh,
        cos * sin * (uu - hh) + (cos * cos - sin * sin) * uh,
        sin * sin * uu + 2 * cos * sin * uh + cos * cos * hh,
    )


@frozen
class _Problem:
    """The quartic in the axes of the places: min big u^2 + small h^2 + w z^2 - 2 along u - 2 across h - 2 v
    z."""

    big: float
    small: float
    along: float
    across: float
    w: float
    v: float

    def cost(self, u: float, h: float) -> float:
        z = u * u + h * h
        square = self.big * u * u + self.small * h * h + self.w * z * z
        return square - 2 * (self.along * u + self.across * h + self.v * z)

    def _excess(self, lam: float) -> float:
        """u^2 + h^2 - z at the stationary point of multiplier lam: the root is where it vanishes."""
        u, h = self.along / (self.big + lam), self.across / (self.small + lam)
        return u * u + h * h - (self.v + lam / 2) / self.w

    def _at(self, lam: float) -> tuple[float, float]:
        return self.along / (self.big + lam), self.across / (self.small + lam)

    def best(self) -> tuple[float, float]:
        """Return the global minimum: the one root with M + lam D positive definite, lam > -small, where the excess
        falls."""
        if self.across == 0.0:
            # The hard case: the two sides fit alike, lam = -small, unless the minimum lies on the axis.
            u = self.along / (self.big - self.small) if self.big > self.small else 0.0
            square = (self.v - self.small / 2) / self.w - u * u
            if square >= 0.0:
                return u, math.sqrt(square)
        low, high = -self.small, -self.small + max(self.big, 1e-300)
        while self._excess(high) > 0.0:
            high += 2 * (high - low)
        return self._at(_bisect(self, low, high, falling=True))

    def second(self, u: float, h: float) -> tuple[float, float] | None:
        """Return the other local minimum, if any: the larger root in -big < lam < -small, where the excess rises.

        Martinez, "Local minimizers of quadratic functions on Euclidean balls and spheres" (SIAM J. Optim. 4,
        1994).
        """
        if self.across == 0.0:
            return (u, -h) if h > 0.0 else None
        low, high = -self.big, -self.small
        # The excess is convex between its poles: go down its slope to the lowest point, or to one below zero. It is
        # written out here and in `_bisect`, where a robot spends most of the time that a place takes.
        big, small, along, across, w, v = self.big, self.small, self.along, self.across, self.w, self.v
        steep, bend_u, bend_h = 1 / (2 * w), -2 * along**2, 2 * across**2
        left, right = low, high
        for _ in range(_BISECTIONS):
            middle = (left + right) / 2
            if not left < middle < right:
                return None
            du, dh = big + middle, small + middle
            at_u, at_h = along / du, across / dh
            if at_u * at_u + at_h * at_h - (v + middle / 2) / w < 0.0:
                return self._at(_bisect(self, middle, high, falling=False))
            if bend_u / du**3 - bend_h / dh**3 < steep:
                left = middle
            else:
                right = middle
        return None


def _bisect(problem: _Problem, low: float, high: float, *, falling: bool) -> float:
    """Return the root of the excess in (low, high), where it changes sign; never evaluates it at the ends, which are
    poles."""
    big, small, along, across, w, v = problem.big, problem.small, problem.along, problem.across, problem.w, problem.v
    for _ in range(_BISECTIONS):
        middle = (low + high) / 2
        if not low < middle < high:
            break
        u, h = along / (big + middle), across / (small + middle)
        if (u * u + h * h - (v + middle / 2) / w > 0.0) == falling:
            low = middle
        else:
            high = middle
    return high if falling else low
