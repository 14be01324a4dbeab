"""The actions that a `Lockstep` asks of its host, to be carried out in the order given."""

from functools import lru_cache
from typing import NamedTuple

from swarm.core.lockstep.frames import Snapshot
from swarm.frozen import frozen

_AROUND = "around"
"""Last chunk of the key of a frame that takes another way than the link to its receiver."""

_MAX_KEYS = 256
"""Keys that are remembered: a robot meets a handful from each neighbour, over and over."""


@frozen
class Compute:
    """Run the app's step and answer with `computed()`. One at a time."""

    k: int
    """Iteration of the values: the step gives x(k+1)."""
    own: bytes
    values: dict[str, bytes]
    """The neighbours' x(k), sorted by name: sums in this order are the same on every run (R8)."""


@frozen
class Save:
    """Write this, encoded, atomically in place of the last one, before the `Send` that follows (R5).

    It shares what is known of the neighbours with the core: to be carried out before the core hears anything new."""

    snapshot: Snapshot


@frozen
class Send:
    """Publish a frame under the key `key_of` this, of which the receiver makes an `Address`."""

    data: bytes
    to: str | None
    """One neighbour, or None for all of them."""
    around: bool = False
    """Over other robots, since the link is silent."""


def key_of(channel: str, to: str | None, *, around: bool) -> str:
    """Return the key under which a frame is published. `channel` is the key for all neighbours; with `to` the frame
    goes to one."""
    if to is None:
        return channel
    return f"{channel}/{to}/{_AROUND}" if around else f"{channel}/{to}"


class Address(NamedTuple):
    """The parts of a frame's key: `swarm/<sender>/app/<app>/sync/<channel>`, and what `key_of` appends to it."""

    sender: str
    app: str
    channel: str
    """A `Channel`, or the chunk of what robots say about the members."""
    to: str | None
    """One neighbour, or None for all of them."""
    around: bool
    """Whether the frame has not come over the link with its sender."""


@lru_cache(maxsize=_MAX_KEYS)
def address_of(key: str) -> Address | None:
    """Take a key apart; None for one of anything else."""
    match key.split("/"):
        case [_, sender, "app", app, "sync", channel]:
            return Address(sender, app, channel, None, around=False)
        case [_, sender, "app", app, "sync", channel, to]:
            return Address(sender, app, channel, to, around=False)
        case [_, sender, "app", app, "sync", channel, to, last] if last == _AROUND:
            return Address(sender, app, channel, to, around=True)
    return None


@frozen
class Advanced:
    """This robot is at iteration k with `value`. A restarted robot says the one it goes on from again."""

    k: int
    value: bytes


@frozen
class Waiting:
    """Iteration k waits for these robots; no robots: the wait is over."""

    k: int
    peers: tuple[str, ...]


@frozen
class Fault:
    """Going on could fork the trajectory, so this robot stops here. The reason names the robot at fault."""

    reason: str


@frozen
class Finished:
    """The last iteration is reached; the process stays until `Lockstep.done` (R7)."""

    k: int


Action = Compute | Save | Send | Advanced | Waiting | Fault | Finished
