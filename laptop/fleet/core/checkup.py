"""The data that `swarm doctor` has of a robot, and the findings of its checks."""

from collections.abc import Callable, Mapping
from dataclasses import field
from typing import Any

from services.balancer.core import faults
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
    """The answer of `swarm.onboard.bootstrap.examine`; None for a simulated robot, which has no computer of its own."""
    bus: Mapping[str, Any] | None
    """The newest message of each topic; None if the bus could not be heard."""
    digest: str = ""
    """SHA-256 of our swarm.toml."""
    now: float = 0.0
    """Time of this computer when the robot was asked, seconds since 1970."""
    disk: int | None = None
    """Bytes left where a simulated robot keeps its files."""
    addresses: Mapping[str, str] = field(default_factory=dict)
    """The Bluetooth addresses in the configuration, by robot."""
    key: Mapping[str, Any] | None = None
    """Mode, owner and ids of the key file."""

    @property
    def facts(self) -> Mapping[str, Any]:
        """Return the facts about the robot's own computer. Raises `SimulatedError` where it has none."""
        if self.system is None:
            raise SimulatedError
        return self.system

    def said(self, topic: str) -> Mapping[str, Any]:
        """Return the newest message under a topic, empty where there was none."""
        return dict((self.bus or {}).get(topic) or {})


@frozen
class Finding:
    """The result of a check."""

    state: str
    """ok, warning, bad, or skipped if the check does not apply."""
    text: str
    """What the check has found."""
    remedy: str = ""
    """What to do; empty if nothing has to be done."""


@frozen
class Check:
    """One line of the doctor's report, and of the checklist in docs/reference/robot/doctor-checks.md."""

    name: str
    question: str
    """The check's line in the checklist, which says what is true on a robot without faults."""
    judge: Callable[[ExaminedRobot], Finding]


def ok(text: str) -> Finding:
    """Return a finding without a problem."""
    return Finding("ok", text)


def warning(text: str, remedy: str) -> Finding:
    """Return a finding of something that works badly or will soon fail."""
    return Finding("warning", text, remedy)


def bad(text: str, remedy: str) -> Finding:
    """Return a finding of something that does not work."""
    return Finding("bad", text, remedy)


def skipped(text: str) -> Finding:
    """Return a finding that the check does not apply to this robot."""
    return Finding("skipped", text)


SIMULATED = skipped("a simulated robot has none")
"""The answer of a check that would examine a simulated robot's own computer."""


STAND = "swarm balance stand"


def recovery(fault: Mapping[str, Any], stopped: Mapping[str, Any]) -> str:
    """Return what a person does about a robot's fault, empty where there is none. `stopped`: its `mesh/stopped`, by
    which a stop may have been taken back."""
    if fault.get("name") == faults.STOPPED and stopped.get("stopped") is False:
        return STAND
    return str(fault.get("recovery") or "") if fault.get("name") else ""
