"""`swarm measure rtt|throughput ... [--plot FILE]` on a laptop: what a robot measures, and a picture of it."""

import argparse
from collections.abc import Sequence
from pathlib import Path

from laptop.plotting.style import add_plot, figure
from swarm.onboard.measure import links
from swarm.onboard.measure.figures import Series


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare what a robot's commands take, and `--plot`."""
    links.add_arguments(parser)
    add_plot(parser)


def run(args: argparse.Namespace) -> int:
    """Measure, print and draw. Return 1 where something was not answered at all."""
    robot, series = links.measured(args)
    if args.plot is not None:
        draw(args.plot, robot, args.what, series)
    return links.code(series)


def draw(path: Path, robot: str, what: str, series: Sequence[Series]) -> None:
    """Draw figure 3.19 of the thesis: round trip by payload, and goodput beside it, with a line for each way of
    sending."""
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
