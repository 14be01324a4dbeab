"""Samples of a calibration: what a module reported where its robot truly was. Two layouts of CSV are read.

Ours, written by `swarm calibrate`, one line for each range (a report of four ranges makes four lines), SI units, empty
where there was none, heading empty where it was not told:

    place,x,y,heading,t,module,distance,px,py

The thesis' (its folder calibration/): a line with one number begins the place of that number; a line of three is a
sample, `range to the target, x, y` in mm. It does not say where its places are: who reads it does, `THESIS_PLACES` for
the thesis' own recording.
"""

import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

from services.dwm.core.estimation.filters import Place, inliers, inlying_places, mean
from swarm.errors import RecordingError
from swarm.recording.thesis_ranges import ThesisRecording, expect, finite

HEADER = "place,x,y,heading,t,module,distance,px,py"

TARGET = "C933"
"""The thesis' target, which stood at TARGET_PLACE."""
TARGET_PLACE = (0.5, 1.0)

THESIS_PLACES_CM = (
    (25, 100), (75, 100), (100, 100), (125, 100), (150, 100), (175, 100), (200, 100), (50, 0), (50, 25), (50, 50),
    (50, 75), (50, 125), (50, 150), (50, 175), (100, 150), (150, 150), (150, 50), (100, 50), (0, 175), (175, 175),
    (175, 25), (0, 25),
)  # fmt: skip
"""Place k of the thesis' recording is the k-th."""
THESIS_PLACES: tuple[Place, ...] = tuple((x / 100, y / 100) for x, y in THESIS_PLACES_CM)
"""m."""

_MM = 1000.0
_MAX_RANGE = 1000.0
"""Largest range that is accepted, m."""

Point3 = tuple[float, float, float]


class RangeSample(NamedTuple):
    """One range of one report; lengths in m."""

    place: int
    x: float
    """The robot's true place."""
    y: float
    heading: float | None
    """The robot's heading as given, rad; None if it was not given."""
    t: float
    """Time in s, the same for all ranges of a report."""
    module: str
    distance: float
    """Distance as reported."""
    px: float | None
    """The place as the module reported it; None without a fix."""
    py: float | None


@dataclass(frozen=True)
class SampleGroup:
    """The ranges to one module at one place and, where it was told, in one orientation."""

    place: int
    true: float
    """m."""
    heading: float | None
    values: tuple[float, ...]

    @cached_property
    def mean(self) -> float:
        """Return the mean without outliers (eq. 2.1)."""
        return mean(inliers(self.values))

    @cached_property
    def raw_mean(self) -> float:
        """Return the mean of all values."""
        return mean(self.values)


@dataclass(frozen=True)
class Spot:
    """The reported positions at one place."""

    place: int
    x: float
    """True, m."""
    y: float
    values: tuple[Place, ...]

    @cached_property
    def mean(self) -> Place:
        """Return the mean place without outliers (figure 2.12)."""
        return _centroid(inlying_places(self.values))

    @cached_property
    def raw_mean(self) -> Place:
        """Return the mean of all places."""
        return _centroid(self.values)


def read(text: str, name: str, places: Sequence[Place] | None = None, module: str = TARGET) -> list[RangeSample]:
    """Return the samples of a file in either layout; `name` is for the messages. Raises `RecordingError`.

    A file in the thesis' layout needs `places`, the k-th that of place k (m), and its ranges go to `module`.
    """
    lines = text.splitlines()
    own = bool(lines) and lines[0].strip() == HEADER
    samples = _read_own(lines, name) if own else _read_thesis(lines, name, places, module)
    if not samples:
        raise RecordingError(f"{name}: holds no samples")
    return samples


def write(sample: RangeSample) -> str:
    """Return a sample as a line of our layout, without its end."""
    return ",".join("" if value is None else str(value) for value in sample)


def digest(samples: Sequence[RangeSample]) -> str:
    """SHA-256 over the samples in our layout: says of a calibration what it was made from."""
    return hashlib.sha256("\n".join(map(write, samples)).encode()).hexdigest()


def groups(samples: Sequence[RangeSample], modules: Mapping[str, Point3]) -> list[SampleGroup]:
    """Ranges to modules whose places (x, y, z) are known, the robot's antenna at height 0, by place and orientation."""
    found: dict[tuple[int, str, float | None], list[RangeSample]] = {}
    for sample in samples:
        if sample.module in modules:
            found.setdefault((sample.place, sample.module, sample.heading), []).append(sample)
    return [
        SampleGroup(
            place,
            math.dist((of[0].x, of[0].y, 0.0), modules[module]),
            heading,
            tuple(sample.distance for sample in of),
        )
        for (place, module, heading), of in found.items()
    ]


def spots(samples: Sequence[RangeSample]) -> list[Spot]:
    """Positions by place, each report once."""
    found: dict[int, dict[float, RangeSample]] = {}
    for sample in samples:
        if sample.px is not None:
            found.setdefault(sample.place, {})[sample.t] = sample
    result = []
    for place, of in found.items():
        reports = list(of.values())
        values = tuple((s.px, s.py) for s in reports if s.px is not None and s.py is not None)
        result.append(Spot(place, reports[0].x, reports[0].y, values))
    return result


def of_recording(recording: ThesisRecording, place: Place, module: str = TARGET) -> list[RangeSample]:
    """Return the samples of a robot in a localization run: ranges to the target, called `module`, from its true
    place (x, y in m)."""
    return [
        RangeSample(0, *place, None, t, module, row.distance, row.x, row.y)
        for t, row in zip(recording.times, recording.rows, strict=True)
    ]


def _read_own(lines: Sequence[str], name: str) -> list[RangeSample]:
    samples = []
    for number, line in enumerate(lines[1:], 2):
        if line.strip():
            try:
                samples.append(_own_sample(line.split(",")))
            except ValueError as error:
                raise RecordingError(f"{name}:{number}: {error}") from None
    return samples


def _own_sample(cells: Sequence[str]) -> RangeSample:
    expect(len(cells) == 9, f"{len(cells)} columns, expected 9 ({HEADER})")
    expect(cells[0].strip().isdigit(), f"the place {cells[0].strip()[:40]!r} is no number from 0")
    x, y, t, distance = (_number(cells[i]) for i in (1, 2, 4, 6))
    heading, px, py = (_number(cells[i]) if cells[i].strip() else None for i in (3, 7, 8))
    expect(0 <= distance < _MAX_RANGE, f"a range of {distance:g} m")
    expect((px is None) == (py is None), "px without py, or py without px")
    return RangeSample(int(cells[0]), x, y, heading, t, cells[5].strip(), distance, px, py)


def _read_thesis(lines: Sequence[str], name: str, places: Sequence[Place] | None, module: str) -> list[RangeSample]:
    samples: list[RangeSample] = []
    place = -1
    for number, line in enumerate(lines, 1):
        try:
            values = [_number(cell) for cell in line.split(",")]
            if len(values) == 1:
                expect(
                    places is not None,
                    "in the thesis' layout, which does not say where place 0, 1, ... are: give them by "
                    '--places "x,y x,y ..." (m), or --places thesis for its own recording',
                )
                known = len(places or ())
                expect(values[0] in range(known), f"place {values[0]:g}, and there are places 0 to {known - 1}")
                place = int(values[0])
                continue
            expect(
                len(values) == 3,
                f"{len(values)} columns: neither ours (first line {HEADER}) nor the thesis' layout",
            )
            expect(place >= 0, "a sample before the first place")
            expect(0 <= values[0] < _MAX_RANGE * _MM, f"a range of {values[0]:g} mm")
        except ValueError as error:
            raise RecordingError(f"{name}:{number}: {error}") from None
        distance, px, py = (value / _MM for value in values)
        x, y = (places or ())[place]
        samples.append(RangeSample(place, x, y, None, float(number), module, distance, px, py))
    return samples


def _number(text: str) -> float:
    value = finite(text)
    if value is None:
        raise ValueError(f"{text.strip()[:40]!r} is no number")
    return value


def _centroid(places: Sequence[Place]) -> Place:
    return mean([place[0] for place in places]), mean([place[1] for place in places])
