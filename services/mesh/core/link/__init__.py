"""A connection with a neighbour, from the call to its end, and what a robot keeps of that neighbour.

`session` is one connection; it owns an `outbox` (what waits, by class), a window and fragments (`flow`), heartbeats
(`round_trips`) and follows the mesh `clock`, which rests on the `link_clock` of each neighbour. `calls` says who calls
whom, `neighbour` keeps what lasts longer than a connection. The classes of this module are what a connection tells its
owner.
Users: `calling`, `connections` and `node`; `bulk` uses `round_trips`, `routing` uses `calls`.
"""

from typing import NamedTuple

from swarm.frozen import frozen


@frozen
class LinkUp:
    """The handshake is over on both sides; messages pass."""

    peer: str


@frozen
class LinkSuspect:
    """An event: nothing was heard on the link for a while."""


@frozen
class LinkRecovered:
    """A suspect link was heard again."""


@frozen
class LinkDown:
    """A link that was up has ended."""

    reason: str
    code: int | None = None
    """Why we ended it (codes of BYE); None where the other end or the transport did."""
    said: int | None = None
    """Why the other end did, by its BYE; None where it said nothing."""


@frozen
class HandshakeFailed:
    """A connection ended before it was up."""

    reason: str
    code: int | None
    """Why we refused it (codes of BYE); None where the other end or the transport ended it."""
    said: int | None = None
    """Why the other end refused it, by its BYE; None where it said nothing."""


class Received(NamedTuple):
    """A message of the peer that may go on our bus."""

    key: str
    payload: bytes
    priority: int
    """Its class, as in `frames`."""
    overlay: int = 0
    """The overlay of its channel, as in `frames`; what is not for `neighbours` goes to the overlays first."""


LinkEvent = LinkUp | LinkSuspect | LinkRecovered | LinkDown | HandshakeFailed | Received
