"""What lays hands on the robots of a page, beyond what is said on a bus: of a simulation, or far away."""

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any, Protocol

from swarm.errors import LocalError
from swarm.messages.codec import Value

PageAction = Callable[[Mapping[str, Any]], str]
"""Carries out `{act: NAME, ...}`, or begins to; says what, in words. Raises `LocalError`, and `KeyError`, `TypeError`,
`ValueError` or `OSError` where something is missing or wrong."""

MAX_CUT_S = 600.0


class RobotActions(Protocol):
    """Simulated robots, or real ones."""

    @property
    def acts(self) -> Mapping[str, PageAction]:
        """What can be done to these robots; a page shows no other."""

    def give(self, robots: Sequence[str], app: str, values: Mapping[str, Value]) -> list[str]:
        """Have an app's parameters set on robots whose bus is not near; those of them that cannot be asked."""

    def close(self) -> None:
        """Give up what is under way."""


def named(name: object, robots: Collection[str]) -> str:
    """A robot's name; `LocalError` where it is none of these."""
    if str(name) not in robots:
        raise LocalError(f"no robot {str(name)[:20]!r}, there are {', '.join(robots)}")
    return str(name)


def cut(asked: Mapping[str, Any], robots: Collection[str]) -> tuple[tuple[str, str], float]:
    """The two ends of the link that is to be cut, and for how long, s; 0 = it is to be mended."""
    ends, seconds = (named(asked["robot"], robots), named(asked["peer"], robots)), float(asked["seconds"])
    if not 0.0 <= seconds <= MAX_CUT_S or not math.isfinite(seconds):
        raise LocalError(f"cut: expected 0 (mend) to {MAX_CUT_S:g} s, got {seconds:g}")
    return ends, seconds
