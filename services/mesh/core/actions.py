"""The actions that the mesh's cores ask for: the first four of the node, the others of its shell.

A node also hands `link.Received` on among its actions: a message to be published on the own bus.
"""

from collections.abc import Callable
from typing import NamedTuple

from services.mesh.core.link import Received
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
    """The code of BYE, which tells the reason."""


class Neighbours(NamedTuple):
    """Send what is for neighbours to these robots, whichever links lead to them."""

    robots: frozenset[str]


@frozen
class Dial:
    """Make a connection to this neighbour, then call `dialled` or `dial_failed`."""

    peer: str


@frozen
class Close:
    """Send what the session still has, as far as that needs no waiting, then close its transport."""

    session: Session


@frozen
class Supervise:
    """The connection of a session whose central we are to be is given up after so much silence, s: its transport need
    not keep what it could not deliver for longer. If this robot is not the central yet, it becomes the central."""

    session: Session
    seconds: float


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


@frozen
class WriteStops:
    """Write `RobotOverlays.stops_file()` anew, which is kept through restarts of the process."""


Emit = Callable[[Transmit], None]
LinkAction = Connect | Disconnect | Neighbours | Write | LogLine
"""What a topology asks of its node."""
Action = Dial | Close | Supervise | LinksChanged | LogLine | Write | WriteStops | Received
"""What a node asks of its shell."""

MAX_LOGGED = 256
"""Different problems logged; later new ones are only counted."""


class Actions:
    """The actions that a node asks of its shell, in the order in which the shell carries them out."""

    def __init__(self) -> None:
        self._actions: list[Action] = []
        self._logged: set[str] = set()

    def add(self, *actions: Action) -> None:
        self._actions += actions

    def log_once(self, problem: str, text: str) -> None:
        """Log a problem the first time only: neighbours may repeat it as often as they like."""
        if problem not in self._logged and len(self._logged) < MAX_LOGGED:
            self._logged.add(problem)
            self._actions.append(LogLine(text, problem=True))

    def log_link(self, text: str) -> None:
        """Log what has happened to a link, and publish its state."""
        self._actions += (LinksChanged(), LogLine(text, problem=False))

    def take(self) -> list[Action]:
        """Return the actions since the last call."""
        actions, self._actions = self._actions, []
        return actions
