"""Figures of what was measured: one row for each payload size of one way of sending."""

import statistics
from collections.abc import Sequence

from swarm.core.percentile import percentile
from swarm.frozen import frozen

NEIGHBOURS, UNICAST, FLOOD = "neighbours", "unicast", "flood"
OVERLAYS = (NEIGHBOURS, UNICAST, FLOOD)


@frozen
class Figures:
    """The figures of one payload size."""

    size: int
    """bytes of payload"""
    samples: int
    """Messages answered, or bursts that came whole."""
    lost: int
    """Messages that were not answered."""
    rtt_min: float | None
    """Round trip, s, as the next figures; all are None where no answer came, or where throughput was measured."""
    rtt_median: float | None
    rtt_mean: float | None
    rtt_deviation: float | None
    rtt_p99: float | None
    goodput: float | None
    """bytes/s of payload; None also where a link without a limit brought each burst in one go."""


@frozen
class Series:
    """One way of sending."""

    overlay: str
    to: str
    """The robot, or the robots, that it reaches."""
    hops: int
    """Links on the way; of a flood to the farthest robot."""
    figures: tuple[Figures, ...]

    @property
    def label(self) -> str:
        """Return the name of the series for tables and pictures."""
        return f"{self.overlay} to {self.to}, {self.hops} hop{'s' if self.hops > 1 else ''}"


def of_times(size: int, times: Sequence[float], sent: int, *, both_ways: bool) -> Figures:
    """Return the figures of single messages, each sent when the one before was answered. With `both_ways` the
    payload went there and back, so the rate is 2 s / RTT (thesis, equation 3.1). Otherwise the answer was short: s /
    RTT."""
    lost = sent - len(times)
    if not times:
        return Figures(size, 0, lost, None, None, None, None, None, None)
    ordered = sorted(times)
    median = statistics.median(ordered)
    return Figures(
        size=size,
        samples=len(ordered),
        lost=lost,
        rtt_min=ordered[0],
        rtt_median=median,
        rtt_mean=statistics.fmean(ordered),
        rtt_deviation=statistics.stdev(ordered) if len(ordered) > 1 else 0.0,
        rtt_p99=percentile(ordered, 99),
        goodput=(2.0 if both_ways else 1.0) * size / median,
    )


def of_bursts(size: int, bursts: Sequence[Sequence[float]], count: int) -> Figures:
    """Return the figures of bursts of `count` messages; each burst is the times of its answers, s. The rate counts
    from the first answers to the last, so it does not include the latency."""
    whole = [sorted(burst) for burst in bursts if len(burst) == count]
    rates = [rate for burst in whole if (rate := _rate(size, burst)) is not None]
    lost = sum(count - len(burst) for burst in bursts)
    return Figures(size, len(whole), lost, None, None, None, None, None, statistics.median(rates) if rates else None)


def _rate(size: int, times: Sequence[float]) -> float | None:
    """Return bytes/s. Several messages may arrive in one go: those that came with the first one do not count, or a
    short burst would seem faster than it was."""
    first_twentieth = times[0] + (times[-1] - times[0]) / 20
    first = sum(time <= first_twentieth for time in times)
    passed = times[-1] - times[first - 1]
    return (len(times) - first) * size / passed if passed > 0.0 else None
