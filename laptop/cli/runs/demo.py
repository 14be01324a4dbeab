"""`swarm demo`: three simulated robots find a target together, with a picture at the end."""

import argparse
import sys
from dataclasses import replace
from pathlib import Path

from laptop.cli.runs import sim
from sim.scenario import options as arguments
from swarm.process import log, service

APP = "localization"
ITERATIONS = 300
PLOT = Path("swarm-demo.png")


def main() -> int:
    """Run the demo; the exit code is 0 only when it did what was asked."""
    log.setup("sim")
    _, rest = parser().parse_known_args()
    words = [APP, *rest]
    options = arguments.parse(words)
    if not options.iterations and not options.seconds:
        words.append(f"--iterations={ITERATIONS}")
        options = arguments.parse(words)
    sys.stderr.write("Three simulated robots, each six processes as on a Pi, find a target together.\n")
    return sim.run_simulation(replace(options, plot=options.plot or PLOT), words)


def parser() -> argparse.ArgumentParser:
    """Return the argument parser of `swarm demo`. Only its help is its own: other options are those of `swarm sim`."""
    return argparse.ArgumentParser(
        prog="swarm demo",
        usage="swarm demo [-h] [OPTION ...]",
        allow_abbrev=False,
        description="Start three simulated robots with the processes that run on a Pi, and let them find a target by "
        f"their UWB ranges in {ITERATIONS} iterations of the app {APP}. The command prints a report and draws {PLOT}. "
        "It takes less than a minute.",
        epilog="Every option of swarm sim is allowed as well, for example --json, --virtual or --robots N: see "
        "swarm sim --help.",
    )


if __name__ == "__main__":
    service.run(main)
