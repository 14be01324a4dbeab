"""What a node asks of its shell; what is for the own bus comes as `events.Received`."""

from services.mesh.core.events import Received
from services.mesh.core.link.session import Session
from swarm.frozen import frozen


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
    """`links()` has something new to publish."""


@frozen
class Note:
    """A line for the log."""

    text: str
    problem: bool
    """Whether it is worth a warning."""


@frozen
class Write:
    """Another topology holds (`Linking.to_file`): keep it through restarts."""


Action = Dial | Close | LinksChanged | Note | Write | Received
