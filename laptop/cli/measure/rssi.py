"""`swarm measure rssi ... [--plot FILE]` on a laptop: the signal strength of a Bluetooth link, and a picture of it."""

import argparse

from laptop.plotting.style import TIME, add_plot, figure
from swarm.onboard.measure import rssi


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare what a robot's command takes, and `--plot`."""
    rssi.add_arguments(parser)
    add_plot(parser)


def run(args: argparse.Namespace) -> int:
    link, readings = rssi.measured(args)
    if args.plot is not None:
        with figure(args.plot, figsize=(6, 4), layout="constrained") as picture:
            axes = picture.add_subplot()
            axes.plot([rssi.PERIOD * number for number in range(len(readings))], readings, "o-")
            axes.set(xlabel=TIME, ylabel="RSSI / dB", title=link)
    return 0
