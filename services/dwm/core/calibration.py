"""From what the module reports to what is true: the linear maps of the thesis (eqs 2.8 and 2.10)."""

from swarm.config.types import Affine, Linear


def distance(model: Linear, measured: float) -> float:
    """Eq. 2.8, in m: the inverse of the sensor model m = 1.056 d + 6.3 cm; never below zero."""
    return max(0.0, model.gain * measured + model.offset)


def position(model: Affine, x: float, y: float) -> tuple[float, float]:
    """Eq. 2.10, in m."""
    (a, b), (c, d) = model.matrix
    return a * x + b * y + model.offset[0], c * x + d * y + model.offset[1]
