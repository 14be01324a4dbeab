"""`moving`: `info` for a target that moves. Predict, then dynamic average consensus, on the information of `track`."""

from collections.abc import Mapping, Sequence
from math import fsum
from typing import Annotated, Any

from services.apps.builtin.localization import track
from services.apps.builtin.localization.place import UNKNOWN, Localization
from swarm import Vector, parameter
from swarm.messages.codec import Value

LONGEST_S = 5.0
"""Longest time of an iteration that is believed, s: a longer one is a pause or a restart."""
SHARE = 0.05
"""Share of a new period in the smoothed one."""


class Moving(Localization):
    """q_i follows the mean over all robots of the information on the last iterations, each moved on to now.

    q_i(k+1) = P(q_i + sum_j w_ij (q_j - q_i)) + u_i(k+1), P the linear prediction with forgetting, u_i what the own new
    range says. The sum of all q is at every k the information of all ranges so far: what a central filter has.
    """

    q: Annotated[Vector, track.LENGTH]
    """Information about the mean of the anchors as origin, 280 bytes."""
    _sequence: int = -1
    """The number of the newest measurement that went in: a repeated one says nothing new."""
    _velocity: tuple[float, float] = (0.0, 0.0)
    """The last one found, m an iteration: where the next search begins."""
    _last: tuple[()] | tuple[float, int] = ()
    """Time of the newest measurement, s, and the iteration in which it was new."""
    _period: float = 0.0
    """Smoothed time of an iteration, s; 0 = not yet known."""

    memory: float = parameter(40.0, unit="iterations", low=2)
    """Mean age of what is remembered. A target that turns wants less, noise wants more."""
    sigma_velocity: float = parameter(0.01, unit="m", low=1e-6)
    """Standard deviation of a velocity component before anything is known, m an iteration."""

    def start(self) -> None:
        """The first measurement is the first information."""
        self._last = ()
        self.q = self._new()

    def step(self, neighbours: Sequence[Any]) -> None:
        """Agree, predict, take in the new range."""
        weighted = self.weighted(neighbours)
        mixed = tuple([own + fsum(w * (n.q[i] - own) for w, n in weighted) for i, own in enumerate(self.q)])
        predicted = track.predict(mixed, 1.0 - 1.0 / self.memory)
        self.q = tuple([a + b for a, b in zip(predicted, self._new(), strict=True)])
        self._measure_period()
        found = self._solved()
        self._velocity = (found.vx, found.vy)

    def result(self) -> Mapping[str, Value]:
        """Place of the target, m, and its velocity, m/s (0 while the time of an iteration is not known)."""
        found = self._solved()
        rate = 1.0 / self._period if self._period > 0.0 else 0.0
        return {**self.report((found.x, found.y), found.found), "vx": rate * found.vx, "vy": rate * found.vy}

    def _measure_period(self) -> None:
        """Take the time of an iteration from two measurements that follow each other: after a restart, or in a robot
        that has joined a run, earlier ones say nothing."""
        t = self.robot.measurement.t
        if not self._last:
            self._last = t, self.k
            return
        before, k = self._last
        if t == before:
            return
        self._last = t, self.k
        period = (t - before) / (self.k - k) if self.k > k else 0.0  # a new epoch may do an iteration again
        if 0.0 < period < LONGEST_S:
            self._period += (period - self._period) * (SHARE if self._period else 1.0)

    def _solved(self) -> track.TargetMotion:
        robots = len(self.robot.swarm)
        found = track.solve(self.q, robots, self.sigma_velocity, self._velocity)
        return found or track.TargetMotion(0.0, 0.0, 0.0, 0.0, UNKNOWN)

    def _new(self) -> track.Information:
        sequence = self.robot.measurement.sequence
        if sequence == self._sequence:
            return track.NOTHING
        self._sequence = sequence
        return track.information(*self.seen(), self.sigma())
