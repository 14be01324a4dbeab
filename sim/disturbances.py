"""The disturbances of a run: links are cut, robots switched off, services killed, bodies pushed, buttons pressed.

Times count from the first iteration of all robots that do not come late, or of all where all do. A time `2s..8s` is
drawn between the two by the seed, a robot `any` is one of the swarm, drawn likewise, and `any` at an end of a cut is
one that has a link with the other end: so a sweep over seeds is one over failures.

Each reader of an option raises `argparse.ArgumentTypeError`, which says what was expected.
"""

import argparse
import random
import re
from collections.abc import Collection, Iterable, Sequence
from dataclasses import replace
from typing import TypeVar

from sim.core.actions import MAX_IMPULSE
from sim.scenario.quantities import duration
from swarm.core.graph import Edge
from swarm.errors import ConfigError
from swarm.frozen import frozen

AT_START = "start"
"""The word that stands for the beginning in place of a time."""

ANY = "any"
"""The word that lets the seed choose a robot."""

KILLABLE = ("mesh", "app", "balancer", "dwm", "bus")
"""The services that can be killed; `app` is the app that the run is about."""

IMPULSE = 0.1
"""Default impulse of a push, N s. A robot bears it; 0.5 topples it."""

_ROBOT = "[a-z][a-z0-9_-]*"


@frozen
class Span:
    """A time of a run, s, or two between which the seed draws one."""

    low: float
    high: float

    def __str__(self) -> str:
        return f"{self.low:g}s" if self.low == self.high else f"{self.low:g}s..{self.high:g}s"


@frozen
class Cut:
    """A link that passes nothing for a while."""

    a: str
    b: str
    at: float
    """Seconds after the first iteration of all robots (without an app: after all are ready)."""
    seconds: float
    span: Span | None = None
    """The bounds between which `at` is still to be drawn."""

    def __str__(self) -> str:
        return f"--cut {self.a}-{self.b}@{self.at:.4g}s,{self.seconds:g}s"


@frozen
class Off:
    """A robot that is switched off for a while, and forgets what it knew but for its votes and stops."""

    robot: str
    at: float | None
    """Time like a cut's, s; None: from the beginning."""
    seconds: float
    span: Span | None = None

    def __str__(self) -> str:
        return f"--off {self.robot}@{AT_START if self.at is None else f'{self.at:.4g}s'},{self.seconds:g}s"


@frozen
class Kill:
    """A service that ends at once, and is started again as systemd does."""

    robot: str
    service: str
    at: float
    """s, counted like a cut's."""
    span: Span | None = None

    def __str__(self) -> str:
        return f"--kill {self.robot}.{self.service}@{self.at:.4g}s"


@frozen
class ScheduledPush:
    """A robot that somebody pushes."""

    robot: str
    at: float
    """s, counted like a cut's."""
    impulse: float
    """Impulse from behind, N s; negative: from the front."""
    span: Span | None = None

    def __str__(self) -> str:
        return f"--push {self.robot}@{self.at:.4g}s,{self.impulse:g}"


@frozen
class ScheduledPress:
    """A button that somebody presses."""

    robot: str
    button: str
    at: float
    """s, counted like a cut's."""
    span: Span | None = None

    def __str__(self) -> str:
        return f"--press {self.robot}.{self.button}@{self.at:.4g}s"


Disturbance = Cut | Off | Kill | ScheduledPush | ScheduledPress
D = TypeVar("D", bound=Disturbance)

SWITCHED_OFF = "the robot was switched off then"
NOT_RUNNING = "the service did not run then"
"""Reasons for which a disturbance was not possible."""


def parsed_cut(text: str) -> Cut:
    """Parse a cut `r0-r1@12s,3s`: which link, when, how long. A name may hold a `-`, so `drawn`, which knows the links,
    says where the first name ends."""
    match = _matched(rf"({_ROBOT})-({_ROBOT})@([^,]+),(.+)", text, "a cut such as r0-r1@12s,3s (link, start, length)")
    at, span = _when(match[3])
    return Cut(match[1], match[2], at, _length(text, match[4]), span)


def parsed_off(text: str) -> Off:
    """Parse `r2@5s,10s`, a robot that is switched off: which, when, how long. `r2@start,10s` comes late."""
    match = _matched(rf"({_ROBOT})@([^,]+),(.+)", text, "a robot such as r2@5s,10s (which, from when, how long)")
    at, span = (None, None) if match[2] == AT_START else _when(match[2])
    return Off(match[1], at, _length(text, match[3]), span)


def parsed_kill(text: str) -> Kill:
    """Parse `r2.mesh@5s`, a service that is killed: whose, which, when."""
    wanted = f"a service such as r2.mesh@5s (robot; {', '.join(KILLABLE)}; time)"
    match = _matched(rf"({_ROBOT})\.({'|'.join(KILLABLE)})@(.+)", text, wanted)
    return Kill(match[1], match[2], *_when(match[3]))


def parsed_push(text: str) -> ScheduledPush:
    """Parse a push `r1@5s` or, with its impulse in N s, `r1@5s,-0.2`."""
    wanted = "a push such as r1@5s or r1@5s,-0.2 (robot, time, N s)"
    match = _matched(rf"({_ROBOT})@([^,]+)(?:,(.+))?", text, wanted)
    try:
        impulse = IMPULSE if match[3] is None else float(match[3])
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not {wanted}") from None
    if not 0.0 < abs(impulse) <= MAX_IMPULSE:
        raise argparse.ArgumentTypeError(f"{text!r}: expected at most {MAX_IMPULSE:g} N s either way, and not 0")
    at, span = _when(match[2])
    return ScheduledPush(match[1], at, impulse, span)


def parsed_press(text: str) -> ScheduledPress:
    """Parse a button `r4.A@5s`: whose, which, when."""
    match = _matched(rf"({_ROBOT})\.([ABCabc])@(.+)", text, "a button such as r4.A@5s (robot, button, time)")
    return ScheduledPress(match[1], match[2].upper(), *_when(match[3]))


def drawn(asked: Sequence[D], names: Sequence[str], seed: int, links: Collection[Edge] = ()) -> tuple[D, ...]:
    """Return the disturbances with the times, robots and links that the seed draws. Raises `ConfigError` for a robot or
    a link that does not exist."""
    found = []
    for index, each in enumerate(asked):
        numbers = random.Random(f"{seed} {type(each).__name__} {index}")
        robots = f"the robots are {', '.join(names)}, or {ANY} for one that the seed draws"
        if isinstance(each, Cut):
            text = f"{each.a}-{each.b}"
            fits = _fitting(text, links)
            if not fits:
                raise ConfigError(f"{each}: there is no such link in the topology; {robots}")
            drawing = text.startswith(f"{ANY}-") or text.endswith(f"-{ANY}")
            if not drawing and len({frozenset(way) for way in fits}) > 1:
                meant = ", ".join(f"{a} and {b}" for a, b in fits)
                raise ConfigError(f"{each}: this names several links: {meant}; give one of the robots another name")
            a, b = numbers.choice(fits) if drawing else fits[0]
            each = replace(each, a=a, b=b)  # noqa: PLW2901
        else:
            if each.robot not in names and each.robot != ANY:
                raise ConfigError(f"{each}: {robots}")
            each = replace(each, robot=numbers.choice(names) if each.robot == ANY else each.robot)  # noqa: PLW2901
        if each.span is not None:
            each = replace(each, at=numbers.uniform(each.span.low, each.span.high), span=None)  # noqa: PLW2901
        found.append(each)
    return tuple(found)


def _fitting(text: str, links: Collection[Edge]) -> list[Edge]:
    """Return the links that a text such as `r0-r1` may mean, each with the end first that is first in the text."""
    parts = text.split("-")
    meant = [("-".join(parts[:at]), "-".join(parts[at:])) for at in range(1, len(parts))]
    ways = [way for a, b in links for way in ((a, b), (b, a))]
    return [(a, b) for a, b in ways if any(one in (a, ANY) and other in (b, ANY) for one, other in meant)]


def never(left: Iterable[Disturbance], seconds: float) -> tuple[str, ...]:
    """Return one sentence for each disturbance that is left, since the run ended `seconds` s after its first
    iteration. One that is left from the beginning is a robot that has not come."""
    ended = f"the run ended {seconds:.3g} s after its first iteration"
    return tuple(f"{each}: {ended}" + (f", before {each.robot} came" if each.at is None else "") for each in left)


def _matched(pattern: str, text: str, wanted: str) -> re.Match[str]:
    match = re.fullmatch(pattern, text)
    if match is None:
        raise argparse.ArgumentTypeError(f"{text!r} is not {wanted}")
    return match


def _length(text: str, part: str) -> float:
    """Parse how long a fault lasts, which is the `part` of the option's `text`."""
    seconds = duration(part)
    if not seconds > 0:
        raise argparse.ArgumentTypeError(f"{text!r}: expected a time above zero")
    return seconds


def _when(text: str) -> tuple[float, Span | None]:
    low, dots, high = text.partition("..")
    if not dots:
        return duration(text), None
    span = Span(duration(low), duration(high))
    if not span.low < span.high:
        raise argparse.ArgumentTypeError(f"{text!r}: expected a time such as 5s, or two such as 2s..8s")
    return span.low, span
