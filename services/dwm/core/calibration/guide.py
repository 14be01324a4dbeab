"""Leads a person through a calibration: which place comes next, when to measure, when it is enough.

As the thesis' program did it with the robot's buttons: at each place the robot is turned by a quarter after about ten
samples. Pure: the shell says what was pressed and what was measured, and shows `prompt` and `progress`.
"""

from collections.abc import Sequence
from enum import Enum
from math import degrees, pi, sqrt

from services.dwm.core.calibration.samples import RangeSample
from services.dwm.core.estimation.filters import Place, inliers, mean
from swarm.frozen import frozen

QUARTERS = (0.0, pi / 2, pi, 3 * pi / 2)
"""rad, counter-clockwise from x."""

SAMPLES = 10
"""Reports for each orientation."""

SETTLE = 2
"""Reports that are left out after the start: they may have been measured while the robot was moved."""


class GuideButton(Enum):
    """The wish of the person at the guide."""

    START = "start"
    """Begin to measure here, or stop before there are enough reports."""
    NEXT = "next"
    """Go on to the next place."""
    REDO = "redo"
    """Forget what was measured at this place and measure it anew."""
    QUIT = "quit"
    """End with the samples that there are."""


@frozen
class GuideStop:
    """A place and an orientation to measure at."""

    place: int
    x: float
    """m."""
    y: float
    heading: float
    """rad."""


class Guide:
    """One session; `samples` is what it has gathered."""

    def __init__(self, places: Sequence[Place], headings: Sequence[float] = QUARTERS, samples: int = SAMPLES) -> None:
        self._stops = [GuideStop(k, x, y, heading) for k, (x, y) in enumerate(places) for heading in headings]
        self._at = 0
        self._wanted = samples
        self._reports = 0
        self._settling = 0
        self._places = len(places)
        self.measuring = False
        self.samples: list[RangeSample] = []

    @property
    def done(self) -> bool:
        """Whether the session is over."""
        return self._at >= len(self._stops)

    @property
    def stop(self) -> GuideStop:
        """Return the place at which the robot has to be; only while not done."""
        return self._stops[self._at]

    def press(self, press: GuideButton) -> None:
        """Take a press of the person; without effect once done."""
        if self.done:
            return
        if press is GuideButton.QUIT:
            self.measuring, self._at = False, len(self._stops)
        elif press is GuideButton.START:
            if self.measuring and self._reports:
                self._advance(self._at + 1)
            else:
                self.measuring, self._reports, self._settling = not self.measuring, 0, SETTLE
        elif press is GuideButton.NEXT:
            place = self.stop.place
            after = [i for i, stop in enumerate(self._stops) if stop.place > place]
            self._advance(after[0] if after else len(self._stops))
        else:
            place = self.stop.place
            # Nothing measured here yet: the place before is meant.
            if place > 0 and not any(sample.place == place for sample in self.samples):
                place -= 1
            self.samples = [sample for sample in self.samples if sample.place != place]
            self._advance(next(i for i, stop in enumerate(self._stops) if stop.place == place))

    def report(self, t: float, ranges: Sequence[tuple[str, float]], place: Place | None) -> list[RangeSample]:
        """New ranges (address, m as reported) and the reported place of one report; gives the samples made of it."""
        if self.done or not self.measuring or not ranges:
            return []
        if self._settling:
            self._settling -= 1
            return []
        stop = self.stop
        x, y = place or (None, None)
        new = [RangeSample(stop.place, stop.x, stop.y, stop.heading, t, name, value, x, y) for name, value in ranges]
        self.samples += new
        self._reports += 1
        if self._reports >= self._wanted:
            self._advance(self._at + 1)
        return new

    def prompt(self) -> str:
        """Return what the person has to do now."""
        if self.done:
            return "done"
        stop = self.stop
        where = f"place {stop.place + 1} of {self._places}: ({stop.x:.2f}, {stop.y:.2f}) m"
        return f"{where}, heading {degrees(stop.heading):.0f} degrees"

    def progress(self, module: str) -> str:
        """Return the progress in words, with the live spread of the ranges to `module`."""
        if self.done:
            return f"{len(self.samples)} samples"
        values = [
            s.distance
            for s in self.samples
            if (s.place, s.heading, s.module) == (self.stop.place, self.stop.heading, module)
        ]
        text = f"{self._reports}/{self._wanted}"
        if len(values) < 2:
            return text
        middle = mean(values)
        spread = sqrt(mean([(value - middle) ** 2 for value in values]))
        strange = len(values) - len(inliers(values))
        return f"{text}  {module} {middle:.3f} m +- {100 * spread:.1f} cm, {strange} outliers"

    def _advance(self, to: int) -> None:
        self._at, self.measuring, self._reports = to, False, 0


def grid(corners: Sequence[Place], step: float) -> list[Place]:
    """Places every `step` m over the box around `corners`, half a step from its edge, row by row and back."""
    low_x, high_x = min(x for x, _ in corners), max(x for x, _ in corners)
    low_y, high_y = min(y for _, y in corners), max(y for _, y in corners)
    columns = _steps(low_x, high_x, step)
    places: list[Place] = []
    for row, y in enumerate(_steps(low_y, high_y, step)):
        places += [(x, y) for x in (columns if row % 2 == 0 else columns[::-1])]
    return places


def _steps(low: float, high: float, step: float) -> list[float]:
    count = max(1, round((high - low) / step))
    return [round(low + (high - low) * (i + 0.5) / count, 3) for i in range(count)]
