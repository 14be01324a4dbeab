"""The interface of actions on a page's robots beyond messages on a bus: in a simulation, or on real robots."""

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any, Protocol

from laptop.cli.hand import MAX_CUT_S
from swarm.app.settings import Setting
from swarm.errors import LocalError
from swarm.messages.codec import Value

PageAction = Callable[[Mapping[str, Any]], str]
"""Carries out `{act: NAME, ...}`, or begins to; says what, in words. Raises `LocalError`, and `KeyError`, `TypeError`,
`ValueError` or `OSError` where something is missing or wrong."""


class RobotActions(Protocol):
    """Actions on simulated robots, or on real ones."""

    @property
    def acts(self) -> Mapping[str, PageAction]:
        """Return what can be done to these robots; a page shows no other action."""

    def give(self, robots: Sequence[str], app: str, values: Mapping[str, Value]) -> list[str]:
        """Have an app's parameters set on robots whose bus is not near, and return the robots that cannot be asked."""

    def close(self) -> None:
        """Give up what is under way."""


def named(name: object, robots: Collection[str]) -> str:
    """Return a robot's name. Raises `LocalError` where it is none of these."""
    if str(name) not in robots:
        raise LocalError(f"no robot {str(name)[:20]!r}, there are {', '.join(robots)}")
    return str(name)


def settings_of(asked: Mapping[str, Any]) -> list[Setting]:
    """Return the settings with which an app is to be started, `{"settings": {"gain": 1, "r2.gain": 2}}`. Raises
    `LocalError` for anything else."""
    found = asked.get("settings", {})
    if not isinstance(found, dict):
        raise LocalError("settings: expected parameters and their values")
    settings = []
    for words, value in found.items():
        robot, _, name = words.rpartition(".")
        check_parameter(name, value)
        settings.append(Setting(robot or None, name, value))
    return settings


def check_parameter(name: str, value: object) -> None:
    """Raise `LocalError` where no parameter can have this name or value."""
    if not name.isidentifier() or not isinstance(value, bool | int | float | str):
        raise LocalError("expected the name of a parameter, and a number, a text, true or false")


def cut(asked: Mapping[str, Any], robots: Collection[str]) -> tuple[tuple[str, str], float]:
    """Return the two ends of the link that is to be cut, and for how long, s; 0 = the link is to be mended."""
    ends, seconds = (named(asked["robot"], robots), named(asked["peer"], robots)), float(asked["seconds"])
    if not 0.0 <= seconds <= MAX_CUT_S or not math.isfinite(seconds):
        raise LocalError(f"cut: expected 0 (mend) to {MAX_CUT_S:g} s, got {seconds:g}")
    return ends, seconds
