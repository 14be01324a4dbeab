"""The models that correct what the module reports: ranges and places.

A range: distance = gain m + offset + log ln(m / 1 m) - robot. The thesis' model (eq. 2.8) is gain and offset;
the logarithm stands for what physics says: no scale error, but a bias that grows with the distance, for a weaker signal
is timed later (Decawave APS011). Below the shortest range of the fit the curve goes on as its tangent.

A place: matrix m + offset (eq. 2.10).
"""

from dataclasses import field
from math import log as ln

from swarm.config.types import Affine, Linear
from swarm.frozen import frozen


@frozen
class RangeModel:
    """A model that corrects a reported range; lengths in m."""

    gain: float = 1.0
    offset: float = 0.0
    log: float = 0.0
    """Coefficient of the logarithm, m; 0: the model is linear."""
    low: float = 0.0
    """Shortest range of the fit; used only if `log` is not 0."""
    robot: float = 0.0
    """Length by which this robot's ranges are too long after the other corrections."""
    antenna: tuple[float, float] = (0.0, 0.0)
    """(a, b): ranges are longer by a cos(heading) + b sin(heading)."""

    @classmethod
    def of(cls, model: Linear) -> "RangeModel":
        """Return the model that swarm.toml holds."""
        return cls(model.gain, model.offset)

    def distance(self, measured: float) -> float:
        """Return the distance for a reported range, the antenna's part left in; never below zero."""
        value = self.gain * measured + self.offset - self.robot
        if self.log:
            if measured >= self.low:
                value += self.log * ln(measured)
            else:
                value += self.log * (ln(self.low) + (measured - self.low) / self.low)
        return max(0.0, value)


@frozen
class Calibration:
    """The range model and the place model of one robot."""

    ranges: RangeModel = field(default_factory=RangeModel)
    position: Affine = field(default_factory=Affine)


def position(model: Affine, x: float, y: float) -> tuple[float, float]:
    """Eq. 2.10, in m."""
    (a, b), (c, d) = model.matrix
    return a * x + b * y + model.offset[0], c * x + d * y + model.offset[1]
