"""`diging`: the thesis' gradient tracking with symmetric weights: noise does not pull it to where links are many.

With y = (z + gamma g) / gamma the thesis' eqs 4.4 and 4.5 are DIGing (Nedic, Olshevsky, Shi, SIAM J. Optim. 27, 2017):
x and y are all that has to be sent.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any

from services.apps.builtin.localization import guard
from services.apps.builtin.localization.gradient import gradient
from services.apps.builtin.localization.place import Judged
from services.apps.builtin.localization.thesis import CM, check_bounded
from swarm import float32, parameter
from swarm.messages.codec import Value

Pair = tuple[float, float]


class Diging(Judged):
    """x_i += sum_j w_ij (x_j - x_i) - gamma y_i; y_i += sum_j w_ij (y_j - y_i) + g_i(x_i+) - g_i(x_i). In m."""

    x: float32
    """Estimate, about the mean of the anchors, m."""
    y: float32
    gx: float32
    """Estimate of the mean gradient, m^3."""
    gy: float32
    _x: Pair = (0.0, 0.0)
    _y: Pair = (0.0, 0.0)
    _g: Pair = (0.0, 0.0)

    step_size: float = parameter(0.025, unit="1/m^2", low=0)
    """gamma; 0.025 m^-2 = 2.5e-6 cm^-2 is safe on the thesis' table for all of its graphs."""
    check: bool = parameter(True)
    """Refuse a step size above the bound (`guard`)."""

    def start(self) -> None:
        """The estimate starts at the corner of the table, as the thesis' does."""
        if self.check:
            guard.check_start(self.robot.graph, self.robot.anchors, self.step_size, metropolis=True)
        self.begin_judging()
        ox, oy = self.origin()
        self._x = (-ox, -oy)
        self._y = self._g = self._gradient()
        (self.x, self.y), (self.gx, self.gy) = self._x, self._y

    def on_epoch(self, members: Sequence[str]) -> None:
        """Track anew from where it is, with the members there are."""
        self._y = self._g
        self.gx, self.gy = self._y
        self.judge_anew()

    def step(self, neighbours: Sequence[Any]) -> None:
        """Both sums of differences are of values as sent, so that the sum of all y stays that of all gradients."""
        weighted = self.weighted(neighbours)
        step, old = self.step_size, self._x
        self._x = (
            self._x[0] + math.fsum(w * (n.x - self.x) for w, n in weighted) - step * self._y[0],
            self._x[1] + math.fsum(w * (n.y - self.y) for w, n in weighted) - step * self._y[1],
        )
        check_bounded((CM * self._x[0], CM * self._x[1]), step)
        before, self._g = self._g, self._gradient()
        self._y = (
            self._y[0] + math.fsum(w * (n.gx - self.gx) for w, n in weighted) + self._g[0] - before[0],
            self._y[1] + math.fsum(w * (n.gy - self.gy) for w, n in weighted) + self._g[1] - before[1],
        )
        self.judge([(w, n.part) for w, n in weighted], math.dist(self._x, old))
        (self.x, self.y), (self.gx, self.gy) = self._x, self._y

    def result(self) -> Mapping[str, Value]:
        """Place of the target, m, and what the ranges of all say about it."""
        return self.report(self._x, self.judged())

    def _gradient(self) -> Pair:
        distance, x, y = self.seen()
        return gradient(self._x, distance, (x, y))
