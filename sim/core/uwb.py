"""The errors of a DWM1001 tag: the error model of UWB ranges, and the position that the module computes from them.

Slope, offset and noise are the thesis' (2.3.4, eq. 2.4, re-analysed recordings); the rest is estimated from
the literature on UWB ranging in rooms. Randomness comes in as a generator, so that a seed gives a run.
"""

import math
from collections.abc import Iterable, Sequence

from services.dwm.core.module.tlv import AnchorRange, Location, Position
from swarm.core.random_numbers import RandomNumbers
from swarm.frozen import frozen

MAX_RANGES = 4
"""A tag ranges to at most four modules at a time (PANS)."""

PERIOD = 0.1
"""Seconds between measurements, the module's fastest; an answer in between repeats the last one."""

QUALITY = {3: 60, 4: 90}
"""Quality factor of a position by the number of ranges it comes from [estimated]."""

_STEPS = 20
_CONVERGED = 1e-5
_FAR = 1000.0
"""Distance beyond which a solution does not count, m."""


@frozen
class ErrorModel:
    """Parameters of the range errors, lengths in m."""

    slope: float = 1.056
    offset: float = 0.063
    heading: float = 0.02
    """Amplitude of the term that turns with the robot: no antenna is quite isotropic."""
    noise: float = 0.04
    """Standard deviation in line of sight."""
    hidden: float = 0.05
    """Probability of no line of sight."""
    hidden_excess: float = 0.30
    """Mean of the exponential detour without line of sight."""
    hidden_noise: float = 0.10
    """Standard deviation without line of sight, in place of `noise`."""
    outlier: float = 0.01
    """Probability of a wild error, uniform within +/- `outlier_size`, on top."""
    outlier_size: float = 0.50
    missing: float = 0.02
    """Probability that a module gives no range."""
    engine_offset: float = -0.093
    """What the module's location engine adds to a range before it positions itself. Fitted: from ranges as
    reported, positions would be off by 19 cm, and still by 13 cm after eq. 2.10; the recordings have 7.4 and
    5.4 cm, noise included. With this, eq. 2.10 leaves 2 to 3 cm of bias at the recorded places."""


def error_model(range_noise: float | None) -> ErrorModel:
    """Return the model with this noise in line of sight, m; None: its own."""
    return ErrorModel() if range_noise is None else ErrorModel(noise=range_noise)


@frozen
class Module:
    """A module that tags range to."""

    address: str
    x: float
    """The true place of the module, m."""
    y: float
    z: float
    known: Position
    """The place that the module was given and tells. With quality 0 it has none, and no tag positions itself by it."""


class Tag:
    """The module of one robot."""

    def __init__(self, generator: RandomNumbers, model: ErrorModel | None = None) -> None:
        self._generator = generator
        self._model = model or ErrorModel()
        self._phase = generator.uniform(-math.pi, math.pi)
        self._place = (0.0, 0.0)

    def measure(self, modules: Iterable[Module], x: float, y: float, heading: float, z: float = 0.0) -> Location:
        """Measure at this pose (m, rad), the antenna at the height `z`. Return the module's answer until the next
        measurement."""
        seen = sorted(((math.dist((x, y, z), (m.x, m.y, m.z)), m.address, m) for m in modules), key=lambda s: s[:2])
        ranges = tuple(
            AnchorRange(module.address, self._range(distance, heading), 100, module.known)
            for distance, _, module in seen[:MAX_RANGES]
            if self._generator.random() >= self._model.missing
        )
        return Location(self._position(ranges, z), ranges)

    def _range(self, distance: float, heading: float) -> float:
        model, generator = self._model, self._generator
        measured = model.slope * distance + model.offset + model.heading * math.cos(heading - self._phase)
        if generator.random() < model.hidden:
            measured += generator.expovariate(1 / model.hidden_excess) + generator.gauss(0.0, model.hidden_noise)
        else:
            measured += generator.gauss(0.0, model.noise)
        if generator.random() < model.outlier:
            measured += generator.uniform(-model.outlier_size, model.outlier_size)
        return max(0.0, round(measured, 3))

    def _position(self, ranges: Sequence[AnchorRange], z: float) -> Position:
        """Return the location engine's place; without a fix the last one with quality 0, as the real one does."""
        used = [item for item in ranges if item.position.quality > 0]
        fix = least_squares_point(
            [(item.position.x, item.position.y, item.position.z - z) for item in used],
            [item.distance + self._model.engine_offset for item in used],
        )
        if fix is not None:
            self._place = (round(fix[0], 3), round(fix[1], 3))
        return Position(*self._place, z, 0 if fix is None else QUALITY[len(used)])


def least_squares_point(
    places: Sequence[tuple[float, float, float]], distances: Sequence[float]
) -> tuple[float, float] | None:
    """Return the point at height 0 with the least squares of range errors, by Gauss-Newton from the anchors' centre.

    Return None with fewer than three ranges, with anchors in a line, or where the steps do not converge.
    """
    if len(places) < 3:
        return None
    x = math.fsum(place[0] for place in places) / len(places)
    y = math.fsum(place[1] for place in places) / len(places)
    for _ in range(_STEPS):
        xx = xy = yy = xe = ye = 0.0
        for (ax, ay, az), measured in zip(places, distances, strict=True):
            dx, dy = x - ax, y - ay
            distance = math.sqrt(dx * dx + dy * dy + az * az) or 1e-9
            ux, uy, error = dx / distance, dy / distance, measured - distance
            xx, xy, yy = xx + ux * ux, xy + ux * uy, yy + uy * uy
            xe, ye = xe + ux * error, ye + uy * error
        determinant = xx * yy - xy * xy
        if determinant < 1e-6:
            return None
        step_x, step_y = (yy * xe - xy * ye) / determinant, (xx * ye - xy * xe) / determinant
        x, y = x + step_x, y + step_y
        if math.hypot(step_x, step_y) < _CONVERGED:
            return (x, y) if math.hypot(x, y) < _FAR else None
    return None
