"""Find the target with a gradient method of one's own: agree with the neighbours, then step towards the own circle."""

from math import fsum, hypot
from typing import Annotated

from swarm import SyncApp, Vector, parameter


class FindTarget(SyncApp):
    """Diffusion: x_i = sum_j w_ij x_j, then a gradient step on (|x_i - p_i| - range_i)^2 / 2."""

    x: Annotated[Vector, 2]
    gain: float = parameter(0.3, unit="1", low=0, high=1)
    measured = True

    def start(self):
        """Begin between the anchors."""
        anchors = self.robot.anchors
        self.x = (fsum(a.x for a in anchors) / len(anchors), fsum(a.y for a in anchors) / len(anchors))

    def step(self, neighbours):
        """Mix, then move a part of the way to where the own range says the target is."""
        x, y = (own + fsum(w * (n.x[i] - own) for w, n in self.weighted(neighbours)) for i, own in enumerate(self.x))
        own = self.robot.measurement
        dx, dy = x - own.x, y - own.y
        far = self.gain * (1 - own.distance / max(hypot(dx, dy), 1e-3))
        self.x = (x - far * dx, y - far * dy)

    def result(self):
        """Report the place in metres."""
        return {"x": self.x[0], "y": self.x[1]}
