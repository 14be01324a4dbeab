"""`nids`: the range residuals' least squares by NIDS, two numbers a message, one step size for every graph and scale.

Li, Shi, Yan, "A decentralized proximal-gradient method with network independent step-sizes" (IEEE Trans. Signal
Processing 67, 2019): x(k+2) = (I + W) / 2 [2 x(k+1) - x(k) - a (g(k+1) - g(k))], after x(1) = x(0) - a g(0). What a
robot sends is the bracket.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any

from services.apps.builtin.localization.place import Judged
from swarm import float32, parameter
from swarm.messages.codec import Value

Pair = tuple[float, float]

NEAREST = 1e-3
"""At the robot's own place the direction to the target is undefined; from this distance, m, it counts."""


class Nids(Judged):
    """g_i = (1 - phi_i / |x - p_i|) (x - p_i), the gradient of (|x - p_i| - phi_i)^2 / 2. In m."""

    x: float32
    """The bracket, about the mean of the anchors, m."""
    y: float32
    _bracket: Pair = (0.0, 0.0)
    """The bracket before rounding. Sums over the swarm use these values, since rounding errors would otherwise add
    up."""
    _x: Pair = (0.0, 0.0)
    """The estimate of the target."""
    _g: Pair = (0.0, 0.0)
    """The gradient at the estimate."""
    _seen: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Range and own place, smoothed."""

    gain: float = parameter(0.5, unit="1", low=0.01, high=1)
    """a; the gradient's slope is at most 1 towards or away from the own circle, whatever the scale."""
    smoothing: float = parameter(0.1, unit="1", low=0.001, high=1)
    """Share of a new measurement in range and own place."""

    def start(self) -> None:
        """Begin between the anchors."""
        self.begin_judging()
        self._seen = self.seen()
        self._begin()

    def on_epoch(self, members: Sequence[str]) -> None:
        """Begin anew from where it is, with the members there are."""
        self.judge_anew()
        self._begin()

    def step(self, neighbours: Sequence[Any]) -> None:
        """Half a step of consensus on the brackets gives the new estimate, and that the next bracket."""
        self._seen = self.smoothed(self._seen, self.smoothing)
        weighted = self.weighted(neighbours)
        before, gradient = self._x, self._g
        self._x = (
            self._bracket[0] + math.fsum(w * (n.x - self.x) for w, n in weighted) / 2,
            self._bracket[1] + math.fsum(w * (n.y - self.y) for w, n in weighted) / 2,
        )
        self._g = self._gradient()
        self.judge([(w, n.part) for w, n in weighted], math.dist(self._x, before))
        self._send(before, gradient)

    def result(self) -> Mapping[str, Value]:
        """Place of the target, m, and what the ranges of all say about it."""
        return self.report(self._x, self.judged())

    def _begin(self) -> None:
        """Compute a plain gradient step, and the first bracket."""
        start = self._x
        self._g = self._gradient()
        self._x = (start[0] - self.gain * self._g[0], start[1] - self.gain * self._g[1])
        before, self._g = self._g, self._gradient()
        self._send(start, before)

    def _send(self, before: Pair, gradient: Pair) -> None:
        self._bracket = (
            2 * self._x[0] - before[0] - self.gain * (self._g[0] - gradient[0]),
            2 * self._x[1] - before[1] - self.gain * (self._g[1] - gradient[1]),
        )
        self.x, self.y = self._bracket

    def _gradient(self) -> Pair:
        distance, px, py = self._seen
        dx, dy = self._x[0] - px, self._x[1] - py
        share = 1.0 - distance / max(math.hypot(dx, dy), NEAREST)
        return share * dx, share * dy
