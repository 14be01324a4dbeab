"""Cooperative localization of a target from ranges (thesis 4.3.3). docs/apps.md has the equations.

Every robot measures its range to the target and its own place; together they find the target. All in metres.
"""

from collections.abc import Mapping, Sequence
from typing import Annotated, Any

from services.apps.localization import gradient, ranges
from swarm import SyncApp, Vector, parameter
from swarm.codec import Value
from swarm.errors import AppError

DIVERGED = 1e6
"""An estimate beyond this, m, is none: the iteration goes to infinity within a few more steps."""


class Info(SyncApp):
    """Consensus on the sums of the squared-range problem, solved in closed form by every robot. No step size.

    q_i follows the mean over all robots of their statistics m_i by dynamic average consensus (Zhu, Martinez
    2010): q_i += sum_j w_ij (q_j - q_i) + m_i(k+1) - m_i(k). The sum of all q stays that of all m, whatever
    the ranges do.
    """

    q: Annotated[Vector, 9]
    """Statistics about the mean of the anchors as origin: far from it their differences would be lost in
    rounding."""
    _m: tuple[float, ...] = ranges.NOTHING

    measured = True
    smoothing: float = parameter(0.1, unit="1", low=0.001, high=1)
    """Share of a new measurement in the own statistics: 1 takes the newest alone."""
    sigma_range: float = parameter(0.04, unit="m", low=0.001)
    """Standard deviation of a range."""
    sigma_place: float = parameter(0.035, unit="m", low=0)
    """Standard deviation of the own place along the line to the target."""

    def start(self) -> None:
        """The first measurement is the first opinion."""
        self._m = self.q = self._measured()

    def step(self, neighbours: Sequence[Any]) -> None:
        """One round of dynamic average consensus."""
        new, beta = self._measured(), self.smoothing
        m = tuple(old + beta * (now - old) for old, now in zip(self._m, new, strict=True))
        weighted = self.weighted(neighbours)
        # The difference to each neighbour is formed first: both ends of an edge then add the same amount with
        # opposite signs, and the sum over the swarm stays (algorithm notes of docs/apps.md).
        self.q = tuple(
            own + sum(w * (n.q[i] - own) for w, n in weighted) + (m[i] - self._m[i]) for i, own in enumerate(self.q)
        )
        self._m = m

    def result(self) -> Mapping[str, Value]:
        """Place of the target, m, and the other place that fits as well (the same one if not ambiguous)."""
        ox, oy = self._origin()
        found = ranges.solve(self.q, len(self.robot.swarm))
        if found is None:  # before any measurement has arrived: the first one makes the first state
            found = ranges.Estimate(0.0, 0.0, None, 0, 0.0)
        other = found.other or (found.x, found.y)
        return {
            "x": ox + found.x,
            "y": oy + found.y,
            "sigma": found.sigma,
            "rank": found.rank,
            "ambiguous": found.ambiguous,
            "other_x": ox + other[0],
            "other_y": oy + other[1],
        }

    def _measured(self) -> tuple[float, ...]:
        now, (ox, oy) = self.robot.measurement, self._origin()
        sigma = (self.sigma_range**2 + self.sigma_place**2) ** 0.5
        return ranges.statistics(now.distance, now.x - ox, now.y - oy, sigma)

    def _origin(self) -> tuple[float, float]:
        anchors = self.robot.anchors
        if not anchors:
            return 0.0, 0.0
        return sum(a.x for a in anchors) / len(anchors), sum(a.y for a in anchors) / len(anchors)


class Thesis(SyncApp):
    """Gradient tracking, eqs 4.3-4.6, with the thesis' row weights, started at the origin."""

    x: Annotated[Vector, 2]
    """Estimate, m."""
    z: Annotated[Vector, 2]
    g: Annotated[Vector, 2]
    _cost: float = 0.0

    measured = True
    weights = "row"
    step_size: float = parameter(0.04, unit="1/m^2", low=0)
    """gamma; the thesis' 4e-6 cm^-2 is 0.04 m^-2. Above the limit of graph and geometry it diverges
    (`guard`)."""

    def step(self, neighbours: Sequence[Any]) -> None:
        """Algorithm 4. The measurement of this step enters with the new gradient (eq 4.6)."""
        own = gradient.Node(self.x, self.z, self.g)
        weighted = [(self.robot.own_weight, own)]
        weighted += [(w, gradient.Node(n.x, n.z, n.g)) for w, n in self.weighted(neighbours)]
        now = self.robot.measurement
        new = gradient.iterate(own, weighted, self.step_size, now.distance, (now.x, now.y))
        if not abs(new.x[0]) + abs(new.x[1]) < DIVERGED:
            raise AppError(
                f"the estimate diverges: step_size {self.step_size:g} 1/m^2 is too large for this graph and geometry"
            )
        self.x, self.z, self.g = new.x, new.z, new.g
        self._cost = gradient.cost(new.x, now.distance, (now.x, now.y))

    def result(self) -> Mapping[str, Value]:
        """Place of the target, m, and the own cost, m^4."""
        return {"x": self.x[0], "y": self.x[1], "cost": self._cost}


ALGORITHMS = {"info": Info, "thesis": Thesis}
