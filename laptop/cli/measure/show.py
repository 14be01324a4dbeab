"""What `swarm measure` prints and draws."""

from collections.abc import Sequence
from pathlib import Path

from laptop.cli.measure.figures import NEIGHBOURS, Figures, Series
from laptop.plotting.figure import figure


def table(robot: str, what: str, series: Sequence[Series]) -> list[str]:
    """One part for each way of sending."""
    lines: list[str] = []
    for each in series:
        if what == "throughput":
            lines += [f"{robot}: {each.label}: messages that follow each other", " bytes  bursts  lost    payload B/s"]
            lines += [f"{row.size:>6}{row.samples:>8}{row.lost:>6}{_rate(row):>15}" for row in each.figures]
        else:
            there, rate = ("payload there and back", "2s/RTT") if each.overlay == NEIGHBOURS else ("confirmed", "s/RTT")
            lines += [
                f"{robot}: {each.label}: one message at a time, {there}",
                f" bytes     n  lost  min ms  median    mean      sd     p99{rate:>9} B/s",
            ]
            for row in each.figures:
                times = (row.rtt_min, row.rtt_median, row.rtt_mean, row.rtt_deviation, row.rtt_p99)
                cells = "".join(f"{'-' if time is None else f'{time * 1e3:.1f}':>8}" for time in times)
                lines.append(f"{row.size:>6}{row.samples:>6}{row.lost:>6}{cells}{_rate(row):>13}")
        lines.append("")
    return lines[:-1]


def draw(path: Path, robot: str, what: str, series: Sequence[Series]) -> None:
    """Figure 3.19 of the thesis: round trip by payload, and goodput beside it; a line for each way of sending."""
    with figure(path, figsize=(10 if what == "rtt" else 5.5, 4), layout="constrained") as picture:
        rates = picture.add_subplot(1, 2 if what == "rtt" else 1, 2 if what == "rtt" else 1)
        times = picture.add_subplot(1, 2, 1) if what == "rtt" else None
        for each in series:
            rows = [row for row in each.figures if row.goodput is not None]
            sizes = [row.size for row in rows]
            rates.plot(sizes, [(row.goodput or 0.0) / 1e3 for row in rows], "o-", label=each.label)
            if times is not None:
                means = [(row.rtt_mean or 0.0) * 1e3 for row in rows]
                deviations = [(row.rtt_deviation or 0.0) * 1e3 for row in rows]
                times.errorbar(sizes, means, yerr=deviations, fmt="o-", capsize=3, label=each.label)
        rates.set(xlabel="payload / bytes", ylabel="payload / (kB/s)", ylim=(0, None), title=f"from {robot}")
        rates.legend()
        if times is not None:
            title = f"from {robot}: mean, standard deviation"
            times.set(xlabel="payload / bytes", ylabel="round trip / ms", ylim=(0, None), title=title)


def _rate(row: Figures) -> str:
    return "-" if row.goodput is None else f"{row.goodput:.0f}"
