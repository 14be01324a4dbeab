"""What `swarm.core.epochs` wants done, and what an operator may want of it."""

from dataclasses import dataclass

from swarm.core.epoch_notes import Epoch, Kept


@dataclass(frozen=True, slots=True)
class Keep:
    """Write this where it outlives kills and reboots, before the `Tell` that follows."""

    kept: Kept


@dataclass(frozen=True, slots=True)
class Tell:
    """Send this to all neighbours, whatever epoch they are in."""

    data: bytes


@dataclass(frozen=True, slots=True)
class Switch:
    """Leave the old epoch for this one, whether this robot is in it or not."""

    epoch: Epoch


@dataclass(frozen=True, slots=True)
class Order:
    """What an operator wants: others out, others in, or only the links in force."""

    drop: tuple[str, ...] = ()
    add: tuple[str, ...] = ()
    force: bool = False


Action = Keep | Tell | Switch
