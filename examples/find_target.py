"""Find the target with a gradient method of one's own: agree with the neighbours, then step towards the own circle."""

from math import fsum, hypot
from typing import Annotated

from swarm import SyncApp, Vector, parameter


class FindTarget(SyncApp):
    """Diffusion: x_i = sum_j w_ij x_j, then a gradient step on (|x_i - p_i| - range_i)^2 / 2."""

    place: Annotated[Vector, 2]
    gain: float = parameter(0.3, unit="1", low=0, high=1)
    measured = True

    def start(self):
        """Begin between the anchors."""
        anchors = self.robot.anchors
        self.place = (fsum(a.x for a in anchors) / len(anchors), fsum(a.y for a in anchors) / len(anchors))

    def step(self, neighbours):
        """Mix, then move a part of the way to where the own range says the target is."""
        around = self.weighted(neighbours)
        x, y = (at + fsum(w * (n.place[i] - at) for w, n in around) for i, at in enumerate(self.place))
        own = self.robot.measurement
        dx, dy = x - own.x, y - own.y
        far = self.gain * (1 - own.distance / max(hypot(dx, dy), 1e-3))
        self.place = (x - far * dx, y - far * dy)

    def result(self):
        """Report the place in metres."""
        return {"x": self.place[0], "y": self.place[1]}
