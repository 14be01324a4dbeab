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


Emit = Callable[[Transmit], None]
