"""What a mesh stands between: the bus, clock and log of its robot, and what carries bytes to other robots."""

import logging
from collections import Counter
from collections.abc import Callable
from typing import Any, Protocol, TypeVar

from services.mesh.core.link.session import Session
from swarm.bus.protocol import BusLike

F = TypeVar("F", bound=Callable[..., Any])


class Surroundings(Protocol):
    """What a mesh uses of its `swarm.process.runtime.Runtime`, whose docstrings hold here, and `outside`."""

    @property
    def bus(self) -> BusLike:
        """The robot's bus."""

    @property
    def counters(self) -> Counter[str]:
        """What was dropped or refused, by name."""

    @property
    def log(self) -> logging.Logger:
        """Where the service's messages for people go."""

    @property
    def now(self) -> float:
        """The robot's clock, s."""

    def at(self, time: float, call: Callable[..., object], *arguments: Any) -> None:
        """Call at `time`."""

    def soon(self, call: Callable[..., object], *arguments: Any) -> None:
        """Call after what runs now."""

    def entry(self, call: F) -> F:
        """`call` in a form that any thread may use."""

    def outside(self, call: Callable[..., object], *arguments: Any) -> None:
        """Call after the present entry, when other threads may enter again: a call that waits delays nobody there. The
        calls of an entry keep their order. Under virtual time nothing waits, so the call is made at once."""


class Transport(Protocol):
    """Carries the bytes of the node's sessions. It tells the mesh what happens: see `Mesh.dialled` and below."""

    def dial(self, peer: str) -> None:
        """Make a connection to a robot, then call `Mesh.dialled` or `Mesh.dial_failed`."""

    def flush(self, session: Session) -> None:
        """Send what the session has to send, as far as that needs no waiting, and the rest when it can be sent."""

    def close(self, session: Session) -> None:
        """Send what the session still has, as far as that needs no waiting, then close its connection."""

    def wake(self, deadline: float) -> None:
        """Call `Mesh.due` at this time in place of the one told before. `Mesh.due` may come earlier, never later."""
