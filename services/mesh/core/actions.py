"""What the overlays want their node to do. Deliveries to the own bus are `events.Received`."""

from collections.abc import Callable
from typing import NamedTuple


class Transmit(NamedTuple):
    """A packet for one neighbour, on the channel of `key` in `overlay`."""

    peer: str
    overlay: int
    key: str
    payload: bytes
    priority: int
    latest: bool = False
    """Whether a newer packet of this channel may take the place of this one while it waits."""


class Connect(NamedTuple):
    """This robot is to have a link with a neighbour from now on, whoever dials."""

    peer: str
    once: bool = False
    """Only try to call it once, and tell by `link_up` or `dial_failed`."""


class Disconnect(NamedTuple):
    """This robot is to have no link with a neighbour any more."""

    peer: str
    code: int
    """Of BYE: why."""


class Keep(NamedTuple):
    """Another topology holds: what is kept through restarts is to be written anew."""


class Report(NamedTuple):
    """A line for the log."""

    text: str
    problem: bool
    """Whether it is worth a warning; such a line is logged once."""


Emit = Callable[[Transmit], None]
LinkAction = Connect | Disconnect | Keep | Report
