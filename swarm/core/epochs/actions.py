"""The actions that `swarm.core.epochs` asks of its host, and the requests of an operator to it."""

from swarm.core.epochs.notes import Epoch, SavedEpochs
from swarm.frozen import frozen


@frozen
class SaveEpochs:
    """Write this where it outlives kills and reboots, before the `SendToNeighbours` that follows."""

    kept: SavedEpochs


@frozen
class SendToNeighbours:
    """Send this to all neighbours, whatever epoch they are in."""

    data: bytes


@frozen
class SwitchEpoch:
    """Leave the old epoch for this one, whether this robot is in it or not."""

    epoch: Epoch


@frozen
class EpochRequest:
    """An operator's request: take robots out, take robots in, or only take the links in force."""

    drop: tuple[str, ...] = ()
    add: tuple[str, ...] = ()
    force: bool = False


Action = SaveEpochs | SendToNeighbours | SwitchEpoch
