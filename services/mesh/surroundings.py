"""The interfaces around a mesh: the bus, clock and log of its robot, and the transport of bytes to other robots."""

from collections.abc import Callable
from typing import Any, Protocol

from services.mesh.core.link.session import Session
from swarm.process.runtime import Schedule


class Surroundings(Schedule, Protocol):
    """The environment in which a mesh runs."""

    def outside(self, call: Callable[..., object], *arguments: Any) -> None:
        """Call after the present entry, when other threads may enter again: a call that waits delays nobody there. The
        calls of an entry keep their order. Under virtual time nothing waits, so the call is made at once."""


class Transport(Protocol):
    """Carries the bytes of the node's sessions. It tells the mesh what happens: see `Mesh.dialled` and below."""

    def dial(self, peer: str) -> None:
        """Make a connection to a robot, then call `Mesh.dialled` or `Mesh.dial_failed`."""

    def flush(self, session: Session) -> None:
        """Send what the session has to send, as far as that needs no waiting, and the rest when it can be sent. Call
        `Mesh.flushed` whenever the session has given all that leaves at the time."""

    def close(self, session: Session) -> None:
        """Send what the session still has, as far as that needs no waiting, then close its connection."""

    def supervise(self, session: Session, seconds: float) -> None:
        """Be the central of a connection, and let go of it when it has been silent for somewhat less than this."""

    def wake(self, deadline: float) -> None:
        """Call `Mesh.due` at this time in place of the one told before. `Mesh.due` may come earlier, never later."""
