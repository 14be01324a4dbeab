"""Runs of a simulated robot among UWB anchors, and how far estimates are from its true path.

Ranges as they are after calibration: noise of 4 cm, a bias of 2 cm for each anchor, 1 % of slope, 2 cm that turn with
the robot, no line of sight now and then (+ exponential of mean 40 cm), reported 60 ms late at 10 Hz. Odometry at
25 Hz: wheels with a scale error of 3 % and slip, a gyro with a bias of 0.01 rad/s and noise of 3 mrad / sqrt(s).
"""

import math
import random
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from services.dwm.core.estimation.ekf import Innovation
from services.dwm.core.estimation.filters import PlaceFilter
from services.dwm.core.estimation.multilateration import Fix, multilaterate
from services.dwm.core.estimation.tracker import Tracker
from sim.core.uwb import least_squares_point

ANCHORS = {"D001": (0.0, 0.0, 0.0), "D002": (1.94, 0.0, 0.0), "D003": (1.0, 1.94, 0.0), "C933": (0.5, 1.0, 0.0)}
"""The thesis' table: three anchors and the target."""

SEEDS = 12
SECONDS = 60.0
WARM_UP = 10.0
"""s at the start that do not count: the heading is found and averages fill."""

STEP = 0.01
ODOMETRY_EVERY = 4
REPORT_EVERY = 10
LATENCY = 0.06
SIGMA = 0.04
HIDDEN_MEAN = 0.40
_RADIUS = 0.45
_CENTRE = (1.0, 1.0)


class Pose(NamedTuple):
    """True, at a time."""

    t: float
    x: float
    y: float
    heading: float


@dataclass(slots=True)
class Outcome:
    """What one run gave, by method: (t, x, y)."""

    truth: list[Pose] = field(default_factory=list)
    paths: dict[str, list[tuple[float, float, float]]] = field(default_factory=dict)
    headings: list[tuple[float, float]] = field(default_factory=list)
    """Time and error, rad, of the EKF."""
    innovations: list[Innovation] = field(default_factory=list)
    hidden: list[bool] = field(default_factory=list)
    """Whether each innovation's range was without line of sight."""
    tracker: Tracker | None = None


class Path:
    """Where the robot truly is: a figure of eight at constant speed, or standing with the sway of balancing."""

    def __init__(self, speed: float, generator: random.Random) -> None:
        self._speed = speed
        self._place = generator.choice(((0.5, 1.5), (1.0, 0.5), (1.5, 1.5)))
        self._turned = generator.uniform(-math.pi, math.pi)

    def poses(self) -> list[Pose]:
        """At every step of the run."""
        steps = round(SECONDS / STEP)
        if self._speed == 0.0:
            c, s = math.cos(self._turned), math.sin(self._turned)
            sways = [0.01 * math.sin(2 * math.pi * 0.7 * i * STEP) for i in range(steps)]
            return [
                Pose(i * STEP, self._place[0] + way * c, self._place[1] + way * s, self._turned)
                for i, way in enumerate(sways)
            ]
        poses = []
        x, y, heading = _CENTRE[0], _CENTRE[1], self._turned
        lap = 2 * math.pi * _RADIUS / self._speed
        for i in range(steps):
            poses.append(Pose(i * STEP, x, y, heading))
            rate = self._speed / _RADIUS * (1.0 if i * STEP % (2 * lap) < lap else -1.0)
            middle = heading + 0.5 * rate * STEP
            x, y = x + self._speed * STEP * math.cos(middle), y + self._speed * STEP * math.sin(middle)
            heading += rate * STEP
        return poses


def run(speed: float, hidden: float, seed: int) -> Outcome:
    """One run of a minute at `speed` (m/s), a share `hidden` of the ranges without line of sight."""
    generator = random.Random(f"{speed} {hidden} {seed}")
    truth = Path(speed, generator).poses()
    ranges = _Ranges(generator, hidden)
    odometry = _Wheels(generator)
    tracker = Tracker(ANCHORS, latency=LATENCY)
    averages = {"IQR + MA3": PlaceFilter(3), "IQR + MA15": PlaceFilter(15)}
    outcome = Outcome(truth, {name: [] for name in ("EKF", "least squares", "multilateration", *averages)})
    outcome.tracker = tracker
    late = round(LATENCY / STEP)
    for i, pose in enumerate(truth):
        if i > 0:
            odometry.step(truth[i - 1], pose)
        if i % ODOMETRY_EVERY == 0:
            tracker.odometry(pose.t, *odometry.take())
        if i % REPORT_EVERY or i < late:
            continue
        measured, unseen = ranges.measure(truth[i - late])
        told = tracker.ranges(pose.t, list(measured.items()))
        estimate = tracker.estimate(pose.t)
        if estimate is not None:
            outcome.paths["EKF"].append((pose.t, estimate.x, estimate.y))
            if estimate.heading is not None:
                error = (estimate.heading - pose.heading + math.pi) % (2 * math.pi) - math.pi
                outcome.headings.append((pose.t, error))
        if pose.t > WARM_UP:
            outcome.innovations += told
            outcome.hidden += [unseen[list(ANCHORS)[item.anchor]] for item in told]
        places, distances = [ANCHORS[name] for name in measured], list(measured.values())
        fix = multilaterate(places, distances, 0.0, SIGMA)
        if isinstance(fix, Fix):
            outcome.paths["multilateration"].append((pose.t, fix.x, fix.y))
        plain = least_squares_point(places, distances)
        if plain is not None:
            outcome.paths["least squares"].append((pose.t, *plain))
            for name, average in averages.items():
                outcome.paths[name].append((pose.t, *average.add(*plain)))
    return outcome


def errors(outcome: Outcome, method: str, lag: float = 0.0) -> list[float]:
    """Distance (m) of each estimate after the warm-up from where the robot was `lag` s before."""
    back = round(lag / STEP)
    found = []
    for t, x, y in outcome.paths[method]:
        if t > WARM_UP:
            pose = outcome.truth[max(0, round(t / STEP) - back)]
            found.append(math.hypot(x - pose.x, y - pose.y))
    return found


def rms(values: Sequence[float]) -> float:
    """Root mean square."""
    return math.sqrt(math.fsum(value * value for value in values) / len(values))


def lag(outcomes: Sequence[Outcome], method: str) -> float:
    """By how many s the true path has to be held back to fit the estimates best."""
    candidates = [i * 0.01 for i in range(121)]
    return min(candidates, key=lambda late: rms([e for run in outcomes for e in errors(run, method, late)]))


class _Ranges:
    def __init__(self, generator: random.Random, hidden: float) -> None:
        self._generator = generator
        self._hidden = hidden
        self._bias = {name: generator.gauss(0.0, 0.02) for name in ANCHORS}
        self._phase = generator.uniform(-math.pi, math.pi)

    def measure(self, pose: Pose) -> tuple[dict[str, float], dict[str, bool]]:
        """Ranges by anchor, and which of them are without line of sight."""
        ranges, unseen = {}, {}
        for name, (ax, ay, az) in ANCHORS.items():
            distance = math.dist((pose.x, pose.y, 0.0), (ax, ay, az))
            error = self._bias[name] + 0.01 * distance + 0.02 * math.cos(pose.heading - self._phase)
            error += self._generator.gauss(0.0, SIGMA)
            unseen[name] = self._generator.random() < self._hidden
            if unseen[name]:
                error += self._generator.expovariate(1 / HIDDEN_MEAN)
            ranges[name] = max(0.0, distance + error)
        return ranges, unseen


class _Wheels:
    """Way and turn since they were taken last, with the errors of wheels and gyro."""

    def __init__(self, generator: random.Random) -> None:
        self._generator = generator
        self._scale = 1.0 + generator.gauss(0.0, 0.03)
        self._gyro = generator.gauss(0.0, 0.01)
        self._way = self._turn = 0.0

    def step(self, before: Pose, after: Pose) -> None:
        way = math.hypot(after.x - before.x, after.y - before.y)
        forward = (after.x - before.x) * math.cos(after.heading) + (after.y - before.y) * math.sin(after.heading)
        self._way += math.copysign(way, forward) * self._scale + self._generator.gauss(0.0, 0.0005 * (way > 0))
        self._turn += after.heading - before.heading + self._gyro * STEP
        self._turn += self._generator.gauss(0.0, 0.003 * math.sqrt(STEP))

    def take(self) -> tuple[float, float]:
        taken = self._way, self._turn
        self._way = self._turn = 0.0
        return taken
