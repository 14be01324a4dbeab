"""The options of a lockstep run, the same on all robots: when it ends, and what happens to absent robots.

`swarm run` and `swarm sim` read them from their command line and pass them on to the app host on each robot.
"""

import argparse

from swarm.core.lockstep.stopping import Rule
from swarm.errors import ConfigError
from swarm.frozen import frozen
from swarm.process.arguments import number, whole

AFTER = 10.0
"""Seconds without a message after which a robot is dropped, if the run drops absent robots."""

TOLERANCE = 1e-6
"""The largest change of a state within one step at which an app counts as converged, in the state's unit."""

ROUNDS = 10
"""Iterations for which all robots must have converged."""

MAX_ROUNDS = 10_000

WAIT, DROP = "wait", "drop"

_positive = number(0.0, above=True)


@frozen
class RunOptions:
    """The options of a run: when a lockstep run ends, and what it does about absent robots."""

    last: int | None = None
    """The last iteration; None if the run has no fixed length."""
    rule: Rule | None = None
    """Another condition that ends the run."""
    drop: bool = False
    """Whether the run drops absent robots (`swarm.core.epochs`); otherwise it waits for them."""
    after: float = AFTER
    """Seconds without a message after which an absent robot is dropped."""
    tolerance: float = TOLERANCE
    """The largest change within one step at which an app without a convergence test of its own has converged."""

    @property
    def arguments(self) -> list[str]:
        """Return the command-line arguments that `of` reads as these options."""
        words = [] if self.last is None else ["--iterations", str(self.last)]
        if self.rule is not None and self.rule.rounds is not None:
            words += ["--until", "converged", "--rounds", str(self.rule.rounds), "--tolerance", repr(self.tolerance)]
        if self.rule is not None and self.rule.seconds is not None:
            words += ["--for", repr(self.rule.seconds)]
        if self.drop:
            words += ["--absent", DROP, "--drop-after", repr(self.after)]
        return words


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add all options but `--iterations`."""
    end = parser.add_argument_group("end of a lockstep run, at the same iteration on all robots")
    end.add_argument("--until", choices=("converged",), help="end when all robots have converged")
    end.add_argument(
        "--rounds",
        type=whole(1, MAX_ROUNDS),
        metavar="R",
        help=f"end when they have been converged for R iterations ({ROUNDS})",
    )
    end.add_argument(
        "--tolerance",
        type=_positive,
        metavar="X",
        help="an app without a method converged has converged if its state changes by at most X "
        f"in a step ({TOLERANCE:g})",
    )
    end.add_argument(
        "--for", dest="run_for", type=_seconds, metavar="S", help="end S seconds after the first robot's start"
    )
    away = parser.add_argument_group("missing robots")
    away.add_argument(
        "--absent",
        choices=(WAIT, DROP),
        default=WAIT,
        help="wait for them (default), or go on without "
        "them if a majority is there, and admit them again when they return",
    )
    away.add_argument(
        "--drop-after",
        type=_seconds,
        metavar="S",
        help=f"seconds of silence after which a robot counts as missing ({AFTER:g})",
    )


def of(options: argparse.Namespace) -> RunOptions:
    """Return the run options in `options` and remove their arguments from it. Raises `ConfigError` for an option that
    would change nothing."""
    values = vars(options)
    until, rounds, seconds = values.pop("until"), values.pop("rounds"), values.pop("run_for")
    absent, after, tolerance = values.pop("absent"), values.pop("drop_after"), values.pop("tolerance")
    if until is None and (rounds is not None or tolerance is not None):
        raise ConfigError("--rounds and --tolerance say what --until converged waits for: add it, or leave them out")
    if absent != DROP and after is not None:
        raise ConfigError("--drop-after says when --absent drop drops a robot: add it, or leave it out")
    rule = Rule((rounds or ROUNDS) if until else None, seconds) if until or seconds is not None else None
    return RunOptions(values["iterations"], rule, absent == DROP, after or AFTER, tolerance or TOLERANCE)


def _seconds(text: str) -> float:
    return _positive(text.removesuffix("s"))
