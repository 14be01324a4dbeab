"""What the mesh's cores ask for: `Transmit`, `Connect` and `Disconnect` of the node, the other actions of its shell.

A node also hands `events.Received` on among its actions: a message to be published on the own bus.
"""

from collections.abc import Callable
from typing import NamedTuple

from services.mesh.core.events import Received
from services.mesh.core.link.session import Session
from swarm.frozen import frozen


class Transmit(NamedTuple):
    """Send a packet to one neighbour, on the channel of `key` in `overlay`."""

    peer: str
    overlay: int
    key: str
    payload: bytes
    priority: int
    latest: bool = False
    """Whether a newer packet of this channel may take the place of this one while it waits."""


class Connect(NamedTuple):
    """Have a link with a neighbour from now on, whoever dials."""

    peer: str
    once: bool = False
    """Only try to call it once, and tell by `link_up` or `dial_failed`."""


class Disconnect(NamedTuple):
    """Have no link with a neighbour any more."""

    peer: str
    code: int
    """Of BYE: why."""


@frozen
class Dial:
    """Make a connection to this neighbour, then call `dialled` or `dial_failed`."""

    peer: str


@frozen
class Close:
    """Send what the session still has, as far as that needs no waiting, then close its transport."""

    session: Session


@frozen
class LinksChanged:
    """Publish `Node.links()`: it has something new."""


@frozen
class LogLine:
    """Write a line to the log."""

    text: str
    problem: bool
    """Whether it is worth a warning. A node passes on the first of equal problems."""


@frozen
class Write:
    """Write `Overlays.topology_file()` anew, which is kept through restarts: another topology holds."""


Emit = Callable[[Transmit], None]
LinkAction = Connect | Disconnect | Write | LogLine
"""What a topology asks of its node."""
Action = Dial | Close | LinksChanged | LogLine | Write | Received
"""What a node asks of its shell."""
