"""What a node asks of its shell; what is for the own bus comes as `events.Received`."""

from dataclasses import dataclass

from services.mesh.core.events import Received
from services.mesh.core.session import Session


@dataclass(frozen=True, slots=True)
class Dial:
    """Make a connection to this neighbour, then call `dialled` or `dial_failed`."""

    peer: str


@dataclass(frozen=True, slots=True)
class Close:
    """Send what the session still has, as far as that needs no waiting, then close its transport."""

    session: Session


@dataclass(frozen=True, slots=True)
class LinksChanged:
    """`links()` has something new to publish."""


@dataclass(frozen=True, slots=True)
class Note:
    """A line for the log."""

    text: str
    problem: bool
    """Whether it is worth a warning."""


@dataclass(frozen=True, slots=True)
class Write:
    """Another topology holds (`Linking.to_file`): keep it through restarts."""


Action = Dial | Close | LinksChanged | Note | Write | Received
