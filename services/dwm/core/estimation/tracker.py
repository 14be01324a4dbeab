"""The tracking of a pose from odometry and late ranges: it starts the filter, finds the heading, and starts anew when
the pose is lost.

Ranges alone say nothing of the heading. Until the robot has moved a little, one filter holds the place; then eight
filters begin, each with a heading of its own, and the ranges of the next decimetres tell which of them is right.
A robot that somebody carried away, or a heading that was believed in error, shows by most ranges being rejected for a
second: then everything begins anew.
"""

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import cos, exp, fsum, hypot, log, pi, sin

from services.dwm.core.estimation.ekf import GATE, HEADING, Ekf, EkfNoise, Innovation, Point, X, Y
from services.dwm.core.estimation.motion import DeadReckoning, OdometryNode
from services.dwm.core.estimation.multilateration import NoFix, multilaterate
from swarm.frozen import frozen

LATENCY = 0.060
"""Seconds from a measurement until its report is read: half a period, computing in the module, transfer."""

SILENCE = 0.5
"""Seconds without odometry after which it counts as absent."""

START_REPORTS = 5
"""The first place is made of the medians of so many reports: one range in twenty is a detour by decimetres, and with
three anchors one of them puts the robot at its mirror image behind two of them, which the biases then explain."""

HYPOTHESES = 8
_APART = 10.0
"""A hypothesis whose likelihood is e^10 times smaller than the best one's is given up."""
_TOGETHER = 0.6
"""Difference of headings within which two hypotheses are one, rad."""
_SURE = 0.35
"""Standard deviation below which a heading counts as known, rad."""
_MOVED = 0.05
"""Length of the motion from which on there are hypotheses of the heading, m."""
_TRIED = 0.3
"""Length of the way from which on one of the hypotheses may be accepted, m."""
_DOUBT = 0.6
"""Share of rejected ranges, over about `_MEMORY` of them, at which the filter and not the ranges must be wrong."""
_MEMORY = 40.0
_STANDING = 3.0
"""Seconds of odometry by which motion is distinguished from drift."""
_LOOSE = 0.005
"""Assumed sway of a robot with unknown heading, so with an unknown direction of motion, m / sqrt(s)."""


@frozen
class PoseEstimate:
    """The robot's pose, and its accuracy."""

    t: float
    x: float
    """m."""
    y: float
    covariance: tuple[float, float, float]
    """Variances and covariance (xx, xy, yy) of the place, m^2."""
    heading: float | None
    """rad; None while it is not known."""
    heading_deviation: float | None
    """Standard deviation, rad."""


@dataclass(slots=True)
class _Hypothesis:
    ekf: Ekf
    likelihood: float = 0.0
    """Logarithm of the likelihood, up to a constant."""


class Tracker:
    """One robot's pose. All times are of one clock, in s."""

    def __init__(
        self,
        anchors: Mapping[str, Point],
        height: float = 0.0,
        *,
        latency: float = LATENCY,
        lever: float = 0.0,
        antenna: tuple[float, float] = (0.0, 0.0),
        noise: EkfNoise | None = None,
    ) -> None:
        """`anchors`: (x, y, z) in m by address. `height`: of the antenna, m; `lever`: from the axle up to it, m.

        `antenna`: (a, b) in m; ranges are longer by a cos(heading) + b sin(heading).
        """
        self._index = {name: index for index, name in enumerate(anchors)}
        self._anchors = tuple(anchors.values())
        self._height = height
        self._latency = latency
        self._lever = lever
        self._antenna = antenna
        self._noise = noise or EkfNoise()
        self._motion: DeadReckoning | None = None
        self._filters: list[_Hypothesis] = []
        self._first: deque[Mapping[int, float]] = deque(maxlen=START_REPORTS)  # reports before there are filters
        self._stood: OdometryNode | None = None  # where it stands; None once it has moved and hypotheses run
        self._known = False  # the heading
        self._rolled = 0.0  # m since hypotheses run
        self._doubt = 0.0
        self.problem = "no ranges yet"
        """Why there is no estimate; empty where there is one."""
        self.restarts = 0
        """Number of times that the tracker started again because the ranges contradicted it."""

    def begin(self, t: float) -> None:
        """Odometry begins at `t`, or begins anew: somebody may have carried or turned the robot meanwhile."""
        self._motion = DeadReckoning(t)
        self._filters, self._known, self._doubt = [], False, 0.0
        self._first.clear()
        self.problem = "odometry has just begun"

    def odometry(self, t: float, distance: float, turn: float, tilt: float = 0.0) -> None:
        """The robot rolled `distance` (m) and turned by `turn` (rad) since the last call, and leans by `tilt`."""
        if self._motion is None:
            self.begin(t)
            return
        dt = t - self._motion.newest.t
        if dt <= 0.0:
            return
        self._motion.add(t, distance, turn, tilt)
        if self._stood is None:
            self._rolled += abs(distance)
            for hypothesis in self._filters:
                hypothesis.ekf.predict(distance, turn, dt)
        elif self._filters:
            ekf = self._filters[0].ekf
            ekf.predict(0.0, 0.0, dt)
            ekf.spread(_LOOSE**2 * dt)
            newest = self._motion.newest
            if hypot(newest.u - self._stood.u, newest.v - self._stood.v) > _MOVED:
                self._branch(ekf)
            elif newest.t - self._stood.t > _STANDING:
                self._stood = newest

    def has_odometry(self, now: float) -> bool:
        """Return whether odometry is there and recent."""
        return self._motion is not None and now - self._motion.newest.t <= SILENCE

    def ranges(self, now: float, ranges: Sequence[tuple[str, float]]) -> list[Innovation]:
        """Take the calibrated ranges (address, m) of a report read at `now`; those to unknown modules are left out.

        Gives what each told, of the best hypothesis; nothing while the filter is being started.
        """
        heard = [(self._index[name], distance) for name, distance in ranges if name in self._index]
        if self._motion is None or not heard:
            self.problem = "no odometry" if self._motion is None else "no range to a configured anchor"
            return []
        if self._doubt > _DOUBT:
            self.restarts += 1
            self._filters, self._doubt = [], 0.0
        if not self._filters:
            self._start(heard)
            return []
        told: list[Innovation] = []
        for hypothesis in self._filters:
            innovations = self._update(hypothesis.ekf, heard, now)
            hypothesis.likelihood -= fsum(
                0.5 * (min(item.error**2 / item.variance, GATE) + log(item.variance)) for item in innovations
            )
            told = told or innovations
        for item in told:
            self._doubt += ((not item.accepted) - self._doubt) / _MEMORY
        if self._stood is None and not self._known:
            self._choose()
        return told

    def estimate(self, now: float) -> PoseEstimate | None:
        """Return the pose at `now`; None before there is one."""
        if self._motion is None or not self._filters:
            return None
        x, y, covariance = self._mixture()
        best = self._filters[0].ekf
        if not self._known:
            return PoseEstimate(now, x, y, covariance, None, None)
        dx, dy = self._way(best.state[HEADING], self._motion.newest, self._motion.at(now))
        turn = self._motion.at(now).heading - self._motion.newest.heading
        heading = (best.state[HEADING] + turn + pi) % (2 * pi) - pi
        return PoseEstimate(now, x + dx, y + dy, covariance, heading, best.covariance[HEADING][HEADING] ** 0.5)

    def _start(self, heard: Sequence[tuple[int, float]]) -> None:
        assert self._motion is not None
        self._first.append(dict(heard))
        medians = {index: self._median(index) for index in sorted(set().union(*self._first))}
        fix = multilaterate(
            [self._anchors[index] for index in medians], list(medians.values()), self._height, self._noise.range
        )
        if isinstance(fix, NoFix):
            self.problem = fix.reason
            return
        if len(self._first) < START_REPORTS:
            self.problem = "the first ranges are being compared"
            return
        self.problem = ""
        self._first.clear()
        self._filters = [_Hypothesis(Ekf(self._anchors, self._height, (fix.x, fix.y), 0.0, 0.0, self._noise))]
        self._stood, self._known, self._doubt = self._motion.newest, False, 0.0

    def _median(self, index: int) -> float:
        """Return the median of the first reports' ranges to an anchor. Of an even number the lower one counts, since
        detours are longer."""
        ranges = sorted(report[index] for report in self._first if index in report)
        return ranges[(len(ranges) - 1) // 2]

    def _branch(self, ekf: Ekf) -> None:
        """Begin one filter for each possible heading."""
        self._stood, self._rolled = None, 0.0
        ekf.spread(_MOVED**2)
        self._filters = []
        for k in range(HYPOTHESES):
            twin = ekf.copy()
            twin.set_heading(2 * pi * k / HYPOTHESES, pi / HYPOTHESES)
            self._filters.append(_Hypothesis(twin))

    def _choose(self) -> None:
        """Give up what became unlikely; what is left knows the heading when it agrees."""
        self._filters.sort(key=lambda item: -item.likelihood)
        best = self._filters[0]
        self._filters = [item for item in self._filters if item.likelihood > best.likelihood - _APART]
        headings = [item.ekf.state[HEADING] for item in self._filters]
        agree = all(abs((angle - headings[0] + pi) % (2 * pi) - pi) < _TOGETHER for angle in headings)
        if agree and self._rolled > _TRIED and best.ekf.covariance[HEADING][HEADING] < _SURE**2:
            self._filters = [best]
            self._known = True

    def _update(self, ekf: Ekf, heard: Sequence[tuple[int, float]], now: float) -> list[Innovation]:
        assert self._motion is not None
        newest, then = self._motion.newest, self._motion.at(now - self._latency)
        told = []
        for index, distance in heard:
            if self._stood is not None:
                told.append(ekf.update(index, distance))
                continue
            heading = ekf.state[HEADING] + then.heading - newest.heading
            lean = self._lever * sin(then.tilt)
            dx, dy = self._way(ekf.state[HEADING], newest, then)
            shift = dx + lean * cos(heading), dy + lean * sin(heading)
            excess = self._antenna[0] * cos(heading) + self._antenna[1] * sin(heading)
            told.append(ekf.update(index, distance - excess, shift))
        return told

    @staticmethod
    def _way(heading: float, start: OdometryNode, end: OdometryNode) -> tuple[float, float]:
        """Return the displacement in the anchors' frame between two nodes of the motion, for a robot with `heading`
        at `start`."""
        c, s = cos(heading - start.heading), sin(heading - start.heading)
        u, v = end.u - start.u, end.v - start.v
        return c * u - s * v, s * u + c * v

    def _mixture(self) -> tuple[float, float, tuple[float, float, float]]:
        """Mean and covariance of the place over all hypotheses."""
        top = max(item.likelihood for item in self._filters)
        shares = [exp(item.likelihood - top) for item in self._filters]
        total = fsum(shares)
        x = y = xx = xy = yy = 0.0
        for share, item in zip(shares, self._filters, strict=True):
            x += share / total * item.ekf.state[X]
            y += share / total * item.ekf.state[Y]
        for share, item in zip(shares, self._filters, strict=True):
            p, dx, dy = item.ekf.covariance, item.ekf.state[X] - x, item.ekf.state[Y] - y
            xx += share / total * (p[X][X] + dx * dx)
            xy += share / total * (p[X][Y] + dx * dy)
            yy += share / total * (p[Y][Y] + dy * dy)
        return x, y, (xx, xy, yy)
