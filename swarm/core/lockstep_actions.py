"""What a `Lockstep` asks its host to do or to tell, to be carried out in the order given."""

from swarm.core.lockstep_frames import Snapshot
from swarm.frozen import frozen

AROUND = "around"
"""Last chunk of the key of a frame that takes another way than the link to its receiver."""


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
    """Publish a frame."""

    data: bytes
    to: str | None
    """One neighbour, or None for all of them."""
    around: bool = False
    """Over other robots, since the link is silent."""

    def key(self, channel: str) -> str:
        """What it is published under; `channel` is the key of what all neighbours get."""
        if self.to is None:
            return channel
        return f"{channel}/{self.to}/{AROUND}" if self.around else f"{channel}/{self.to}"


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
