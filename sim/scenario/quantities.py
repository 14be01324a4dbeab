"""The quantities on the command line of `swarm sim`: times, rates, probabilities.

Each reader raises `argparse.ArgumentTypeError`, which says what was expected.
"""

import argparse
import math
import re
from collections.abc import Sequence
from typing import NamedTuple

from services.mesh.links.radio_model import MAX_LOSS
from sim.slots.parameters import SlotParameters
from swarm.app import settings
from swarm.errors import AppError, ConfigError
from swarm.messages.keys import is_name
from swarm.process.arguments import number

_DURATION = {"us": 1e-6, "ms": 1e-3, "s": 1.0, "min": 60.0, "": 1.0}
_SIZE = {"B": 1.0, "kB": 1e3, "MB": 1e6, "": 1.0}
_NUMBER = re.compile(r"([0-9.]+(?:e[+-]?[0-9]+)?) *([a-zA-Z%]*)")

SLOWEST, FASTEST = 0.01, 1000.0
"""Seconds of virtual time a second that a page may wish for."""

MAX_VELOCITY = 10.0
"""Largest velocity of a target, m/s."""

MAX_SKEW = 100e-6
"""Largest error of a clock's rate. It is larger than the error of a crystal, and the largest that the mesh clock is
made for."""


def velocity(text: str) -> tuple[float, float]:
    """Parse a velocity `0.1,-0.03`: vx and vy, m/s."""
    try:
        x, y = map(float, text.split(","))
    except ValueError:
        x = y = math.nan
    if not (abs(x) <= MAX_VELOCITY and abs(y) <= MAX_VELOCITY):
        raise argparse.ArgumentTypeError(f"{text!r} is not a velocity such as 0.1,-0.03 (m/s, below {MAX_VELOCITY:g})")
    return x, y


def _quantity(text: str, units: dict[str, float], what: str) -> float:
    match = _NUMBER.fullmatch(text.strip())
    if match is None or match[2] not in units:
        raise argparse.ArgumentTypeError(f"{text!r} is not {what}")
    try:
        return float(match[1]) * units[match[2]]
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not {what}") from None


def duration(text: str) -> float:
    """Parse a time `30ms`, `3s`, `2min` or a bare number of seconds; return seconds."""
    return _quantity(text, _DURATION, "a time such as 30ms or 3s")


def run_length(text: str) -> float:
    """Parse the length of a run as `duration` does: above zero, or nothing would happen."""
    value = duration(text)
    if value <= 0:
        raise argparse.ArgumentTypeError(f"{text!r}: expected a time above 0, such as 30ms or 3s")
    return value


def rate(text: str) -> float:
    """Parse a rate `78kB`, `1MB` or a bare number of bytes; return bytes per second."""
    value = _quantity(text, _SIZE, "a rate such as 78kB (per second)")
    if value <= 0:
        raise argparse.ArgumentTypeError("a bandwidth must be above zero")
    return value


class AppSetting(NamedTuple):
    """A parameter of an app."""

    app: str
    """The app's name; empty: the first app."""
    setting: settings.Setting


def add_app_settings(parser: argparse._ActionsContainer) -> None:
    """Declare the options that give the apps of a run their parameters, on robots and in a simulation."""
    parser.add_argument("--algorithm", metavar="NAME", help="algorithm of the first app")
    parser.add_argument(
        "--set",
        dest="settings",
        action="append",
        type=setting,
        default=[],
        metavar="[APP/][ROBOT.]NAME=VALUE",
        help="a parameter of the first app or of the one named, for all robots or for one: --set r2.value=3",
    )
    parser.add_argument(
        "--step-size", type=number(0, above=True), metavar="G", help="gradient step in the thesis' unit, 1/cm^2"
    )


def setting(text: str) -> AppSetting:
    """Parse a parameter `value=0.5` or, of one robot, `r2.value=3`; with `led_sync/` before it, of that app."""
    app, slash, rest = text.partition("/") if "/" in text.partition("=")[0] else ("", "", text)
    if slash and not is_name(app):
        raise argparse.ArgumentTypeError(f"{text!r}: {app!r} is no app's name")
    try:
        return AppSetting(app, settings.parse(rest))
    except AppError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def speed(text: str) -> float:
    """Parse a speed `0.5`, or `max`, which is infinity."""
    if text == "max":
        return math.inf
    value = _quantity(text, {"": 1.0}, "a speed such as 0.5, or max")
    if not SLOWEST <= value <= FASTEST:
        raise argparse.ArgumentTypeError(f"expected {SLOWEST:g} to {FASTEST:g}, or max")
    return value


def loss(text: str) -> float:
    """Parse a probability `5%` or `0.05`."""
    value = _quantity(text, {"": 1.0, "%": 0.01}, "a probability such as 5% or 0.05")
    if not value <= MAX_LOSS:
        raise argparse.ArgumentTypeError(f"{text!r}: expected at most {100 * MAX_LOSS:g}%")
    return value


def slots(text: str) -> SlotParameters:
    """Parse a slot radio, `slots` or `slots:stay=0.2,loss=0.1`."""
    kind, _, parameters = text.partition(":")
    if kind != "slots":
        raise argparse.ArgumentTypeError(f"{text!r}: expected slots or slots:NAME=X,...")
    try:
        return SlotParameters.parse(parameters)
    except ConfigError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def skew(text: str) -> float:
    """Parse an error of clocks, `20ppm`."""
    value = _quantity(text, {"ppm": 1e-6}, "an error such as 20ppm")
    if not value <= MAX_SKEW:
        raise argparse.ArgumentTypeError(f"{text!r}: expected at most {1e6 * MAX_SKEW:g}ppm")
    return value


def negative_joined(arguments: Sequence[str]) -> list[str]:
    """Write `--latency -5ms` as `--latency=-5ms`: argparse would take what begins with - for another option."""
    words: list[str] = []
    for word in arguments:
        if words and re.match(r"-[0-9.]", word) and re.fullmatch("--[a-z-]+", words[-1]):
            words[-1] += f"={word}"
        else:
            words.append(word)
    return words
