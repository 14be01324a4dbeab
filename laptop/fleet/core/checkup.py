"""The data that `swarm doctor` has of a robot, and the findings of its checks."""

from collections.abc import Callable, Mapping
from dataclasses import field
from typing import Any

from swarm.config.types import Config
from swarm.frozen import frozen


class SimulatedError(Exception):
    """A simulated robot was asked for its own computer."""


@frozen
class ExaminedRobot:
    """All that was found out about one robot. What could not be asked is None."""

    name: str
    config: Config
    system: Mapping[str, Any] | None
    """Of `swarm.onboard.bootstrap.examine`; None for a simulated robot, which has none of its own."""
    bus: Mapping[str, Any] | None
    """Newest messages by topic; None where nobody could listen."""
    digest: str = ""
    """SHA-256 of our swarm.toml."""
    now: float = 0.0
    """Seconds since 1970, here, when it was asked."""
    disk: int | None = None
    """Bytes left where a simulated robot keeps its files."""
    addresses: Mapping[str, str] = field(default_factory=dict)
    """Bluetooth addresses by robot, as the config has them."""
    key: Mapping[str, Any] | None = None
    """Mode, owner and ids of the key file."""

    @property
    def facts(self) -> Mapping[str, Any]:
        """Return the facts about the robot's own computer. Raises `SimulatedError` where it has none."""
        if self.system is None:
            raise SimulatedError
        return self.system

    def said(self, topic: str) -> Mapping[str, Any]:
        """The newest message under a topic, empty where there was none."""
        return dict((self.bus or {}).get(topic) or {})


@frozen
class Finding:
    """The result of a check."""

    state: str
    """ok, warning, bad, or skipped where it does not apply."""
    text: str
    """What is so."""
    remedy: str = ""
    """What to do; empty where nothing is to be done."""


@frozen
class Check:
    """One line of the doctor's report, and of the checklist in docs/reference/robot/doctor-checks.md."""

    name: str
    question: str
    """The checklist's line: what is so on a robot that is well."""
    judge: Callable[[ExaminedRobot], Finding]


def ok(text: str) -> Finding:
    """Return a finding without a problem."""
    return Finding("ok", text)


def warning(text: str, remedy: str) -> Finding:
    """It works, but not for long, or not well."""
    return Finding("warning", text, remedy)


def bad(text: str, remedy: str) -> Finding:
    """Something does not work."""
    return Finding("bad", text, remedy)


def skipped(text: str) -> Finding:
    """Does not apply here."""
    return Finding("skipped", text)


SIMULATED = skipped("a simulated robot has none")
"""What a check says that asks for a simulated robot's own computer."""
