"""What a step of provisioning finds on a robot, and what it would change there."""

from collections.abc import Callable, Mapping
from typing import Any

from laptop.fleet.core.wish import DesiredRobot
from swarm.frozen import frozen

Facts = Mapping[str, Any]
Change = dict[str, Any]
"""As `swarm.onboard.bootstrap.changes` takes it."""


@frozen
class Verdict:
    """What a step finds."""

    state: str
    """ok, change or failed."""
    text: str
    """What is so; what will be changed; what is wrong and how to mend it."""
    changes: tuple[Change, ...] = ()
    reboot: bool = False
    """In force only after a reboot."""


def ok(text: str) -> Verdict:
    """It is as it should be."""
    return Verdict("ok", text)


def failed(text: str) -> Verdict:
    """It is not, and no change of ours helps."""
    return Verdict("failed", text)


def change(text: str, *changes: Change, reboot: bool = False) -> Verdict:
    """It is not, and these changes help."""
    return Verdict("change", text, changes, reboot)


@frozen
class ProvisioningStep:
    """One idea."""

    name: str
    judge: Callable[[Facts, DesiredRobot], Verdict]
