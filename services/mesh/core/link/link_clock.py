"""The offset between a neighbour's monotonic clock and ours, from two-way samples: a straight line through the best."""

import math
from collections import deque
from typing import NamedTuple

WINDOW = 120.0
"""Seconds of samples a link's estimate rests on."""

BEST = 0.5
"""Share of the samples that is used: those with the smallest round trip waited least in queues. Where the delay only
jitters, all would do better and a quarter worse; where other traffic delays some, it is the other way round."""

_REFIT = 4
"""Once there are `_ENOUGH` samples a line is fitted to every so many new ones: the old fit says nearly the same."""

_ENOUGH = 20

SKEW_AFTER = 10.0
"""Seconds that samples must span before a slope is fitted; over less it would be noise."""

UNKNOWN_SKEW = 30e-6
"""s/s by which two quartz clocks differ (standard deviation), as long as that was not measured."""

MAX_SKEW = 100e-6
"""Largest difference of two clocks' rates believed: crystals are good for +-20 to 30 ppm each."""

STEP = 0.2
"""Seconds of error above which a clock steps, which happens when it first hears of others, and when swarms merge."""

_MAX_SAMPLES = 256


class ClockFit(NamedTuple):
    """Offset of a neighbour's monotonic clock to ours as a straight line."""

    at: float
    offset: float
    skew: float
    error: float
    """Standard error of the offset, s."""
    skew_error: float
    """Standard error of the skew, s/s."""

    def offset_at(self, now: float) -> float:
        """Return the offset at another time."""
        return self.offset + self.skew * (now - self.at)

    def error_at(self, now: float) -> float:
        """Return the standard error at `now`, s. It grows with the distance from the samples' middle."""
        return math.hypot(self.error, self.skew_error * (now - self.at))


class LinkClock:
    """Offset between a neighbour's monotonic clock and ours."""

    def __init__(self) -> None:
        self._samples: deque[tuple[float, float, float]] = deque(maxlen=_MAX_SAMPLES)
        self._unfitted = 0
        self.fit: ClockFit | None = None

    def add(self, now: float, rtt: float, offset: float) -> None:
        """Add a two-way sample of this moment. Its error is at most rtt / 2, so a larger deviation shows that the
        neighbour's clock began anew."""
        if self.fit is not None and abs(offset - self.fit.offset_at(now)) > rtt + STEP:
            self._samples.clear()
        self._samples.append((now, rtt, offset))
        while self._samples[0][0] < now - WINDOW:
            self._samples.popleft()
        self._unfitted += 1
        if self._unfitted >= _REFIT or len(self._samples) < _ENOUGH:
            self._unfitted = 0
            self.fit = self._fit()

    def _fit(self) -> ClockFit:
        by_rtt = sorted(self._samples, key=lambda sample: sample[1])
        best = by_rtt[: max(1, math.ceil(len(by_rtt) * BEST))]
        count = len(best)
        at = math.fsum(sample[0] for sample in best) / count
        mean = math.fsum(sample[2] for sample in best) / count
        skew, skew_error = 0.0, UNKNOWN_SKEW
        square = math.fsum((sample[0] - at) ** 2 for sample in best)
        fitted = self._samples[-1][0] - self._samples[0][0] >= SKEW_AFTER and square > 0.0
        if fitted:
            skew = math.fsum((sample[0] - at) * (sample[2] - mean) for sample in best) / square
            skew = max(-MAX_SKEW, min(MAX_SKEW, skew))
        if count < 2:
            return ClockFit(at, mean, skew, best[0][1] / 2, skew_error)
        rest = math.fsum((sample[2] - mean - skew * (sample[0] - at)) ** 2 for sample in best) / (count - 1)
        if fitted:
            # The slope of some noisy samples says less than that quartz clocks hardly differ: the mean of both, each by
            # what it is worth.
            share = square / (square + rest / UNKNOWN_SKEW**2)
            skew *= share
            skew_error *= math.sqrt(1.0 - share)
        return ClockFit(at, mean, skew, math.sqrt(rest / count), skew_error)
