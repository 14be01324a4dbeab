"""The plan of a sweep's runs: every combination of the listed values, each with every seed."""

import argparse
import itertools
import re
from collections.abc import Sequence

from swarm.app.parameters import split_at_commas
from swarm.errors import ConfigError
from swarm.frozen import frozen

OPTIONS = ("robots", "topology", "algorithm", "latency", "jitter", "loss")
"""Options of `swarm sim` of which a sweep takes lists."""


@frozen
class SweepPoint:
    """One combination of values."""

    choices: tuple[tuple[str, str], ...]
    """Name and value of each list: of `OPTIONS`, and of parameters and first values."""
    options: int = 0
    """The number of choices, those at the beginning, that are of `OPTIONS`: a parameter may have such a name, too."""

    def arguments(self) -> list[str]:
        """Return the arguments for `swarm sim`."""
        found: list[str] = []
        for index, (name, value) in enumerate(self.choices):
            found += [f"--{name}={value}"] if index < self.options else ["--set", f"{name}={value}"]
        return found

    def with_value(self, name: str, value: float) -> "SweepPoint":
        """Return the same point with one parameter more."""
        return SweepPoint((*self.choices, (name, repr(value))), self.options)


@frozen
class Job:
    """One run."""

    point: int
    """The number of the point in the sweep."""
    seed: int
    arguments: tuple[str, ...]
    within: float
    """Distance from its last value within which a settled result stays, in the result's unit."""


def values_of(text: str) -> tuple[str, ...]:
    """Return the values of a list such as `6,12` or `[0,1],[1,0]`."""
    values = tuple(split_at_commas(text))
    if not all(values):
        raise argparse.ArgumentTypeError(f"{text!r} is not a list of values such as 6,12")
    return values


def setting_of(text: str) -> tuple[str, tuple[str, ...]]:
    """Parse a parameter and its values, `gain=0.1,0.2` or `r2.value=3,4`."""
    name, equals, values = text.partition("=")
    if not equals or not name:
        raise argparse.ArgumentTypeError(f"{text!r} is not a parameter with values such as gain=0.1,0.2")
    return name, values_of(values)


def seeds_of(text: str) -> tuple[int, ...]:
    """Parse seeds: `20` means the seeds 1 to 20, `5-9` those from 5 to 9."""
    match = re.fullmatch(r"(\d+)(?:-(\d+))?", text)
    if match is None:
        raise argparse.ArgumentTypeError(f"{text!r} is neither a number of seeds such as 20 nor a range such as 5-9")
    first, last = (1, int(match[1])) if match[2] is None else (int(match[1]), int(match[2]))
    if last < first:
        raise argparse.ArgumentTypeError(f"{text!r}: there is no seed in it")
    return tuple(range(first, last + 1))


def points_of(
    options: Sequence[tuple[str, Sequence[str]]], settings: Sequence[tuple[str, Sequence[str]]] = ()
) -> list[SweepPoint]:
    """Return all combinations of lists of `OPTIONS`, and of parameters and first values; the last list changes
    fastest. Raises `ConfigError` for two lists of one name, which would have one column in the results."""
    lists = [*options, *settings]
    names = [name for name, _ in lists]
    if twice := [name for name in names if names.count(name) > 1]:
        raise ConfigError(
            f"{twice[0]}: two lists have this name: give one of them. Where an option and a parameter of the app have "
            "it, rename the parameter"
        )
    return [
        SweepPoint(tuple(zip(names, chosen, strict=True)), len(options))
        for chosen in itertools.product(*(values for _, values in lists))
    ]


def jobs_of(
    app: str, points: Sequence[SweepPoint], seeds: Sequence[int], rest: Sequence[str], within: float
) -> list[Job]:
    """Return every point with every seed; `rest` are arguments of `swarm sim` for all of them."""
    return [
        Job(index, seed, (app, *point.arguments(), "--seed", str(seed), *rest), within)
        for index, point in enumerate(points)
        for seed in seeds
    ]
