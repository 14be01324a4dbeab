"""`thesis`: gradient tracking as published and as its program did it, to the last bit of a float32."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

from services.apps.builtin.localization import gradient, guard
from services.apps.builtin.localization.place import Judged
from swarm import float32, parameter
from swarm.errors import AppError
from swarm.messages.codec import Value

CM = 100.0
"""cm in a m: the thesis counts in cm, and float32 rounds differently in m."""

DIVERGED = 1e8
"""An estimate beyond this, cm, is none: the iteration goes to infinity within a few more steps."""


class Thesis(Judged):
    """Algorithm 4, eqs 4.3-4.6, with the thesis' row weights, started at the origin.

    Each robot computes in float64 and sends float32, 24 bytes, in cm; 4 more tell how good the place is.
    """

    x: float32
    """Estimate, cm."""
    y: float32
    zx: float32
    """Auxiliary variable of the tracking, cm."""
    zy: float32
    gx: float32
    """Own gradient at x, cm^3."""
    gy: float32
    _own: tuple[tuple[float, float], tuple[float, float], tuple[float, float]] = ((0.0, 0.0), (0.0, 0.0), (0.0, 0.0))
    """x, z and g as computed, before rounding."""
    _cost: float = 0.0

    weights = "row"
    step_size: float = parameter(0.04, unit="1/m^2", low=0)
    """gamma; the thesis' 4e-6 cm^-2 is 0.04 m^-2."""
    check: bool = parameter(True)
    """Refuse a step size above the bound (`guard`): without it the run goes as it goes."""

    def start(self) -> None:
        """The estimate starts at the corner of the table."""
        if self.check:
            guard.check_start(self.robot.graph, self.robot.anchors, self.step_size, metropolis=False)
        (self.x, self.y), (self.zx, self.zy), (self.gx, self.gy) = self._own
        self.begin_judging()

    def on_epoch(self, members: Sequence[str]) -> None:
        """Track anew from where it is, with the members there are."""
        self._own = (self._own[0], (0.0, 0.0), (0.0, 0.0))
        (self.x, self.y), (self.zx, self.zy), (self.gx, self.gy) = self._own
        self.judge_anew()

    def step(self, neighbours: Sequence[Any]) -> None:
        """Algorithm 4. The measurement of this step enters with the new gradient (eq 4.6)."""
        own = gradient.Node(*self._own)
        weighted = [(self.robot.own_weight, own)]
        weighted += [(w, gradient.Node((n.x, n.y), (n.zx, n.zy), (n.gx, n.gy))) for w, n in self.weighted(neighbours)]
        now = self.robot.measurement
        distance, place = CM * now.distance, (CM * now.x, CM * now.y)
        new = gradient.iterate(own, weighted, self.step_size / CM**2, distance, place)
        check_bounded(new.x, self.step_size)
        moved = math.dist(new.x, own.x) / CM
        self._own = (new.x, new.z, new.g)
        (self.x, self.y), (self.zx, self.zy), (self.gx, self.gy) = self._own
        self._cost = gradient.cost(new.x, distance, place) / CM**4
        weights = self.robot.graph.metropolis_weights(self.robot.name)
        self.judge([(weights[n.name], n.part) for n in neighbours], moved)

    def result(self) -> Mapping[str, Value]:
        """Place of the target, m, the own cost, m^4, and what the ranges of all say about the place."""
        ox, oy = self.origin()
        x, y = self._own[0]
        return {**self.report((x / CM - ox, y / CM - oy), self.judged()), "cost": self._cost}


def check_bounded(place: tuple[float, float], step_size: float) -> None:
    """Raise `AppError` where an estimate, cm, has left the world."""
    if not abs(place[0]) + abs(place[1]) < DIVERGED:
        raise AppError(f"the estimate diverges: step_size {step_size:g} 1/m^2 is too large for this graph and geometry")
