"""What the air knows of one link between two controllers."""

import math
from collections import deque
from dataclasses import dataclass, field

from lab.radio.core.pairing import Pairing


@dataclass(eq=False)
class Link:
    """An ACL link. All dictionaries are by the address of a controller."""

    ends: dict[str, int]
    """The handle that each side has for it; they differ."""
    central: str
    """The side that has paged; it alone sets the supervision time-out."""
    supervision: float = math.inf
    """s without a sign of the other side until the link is over, as set by that side's host."""
    silent_since: float | None = None
    """Since when nothing gets through; None where it does."""
    gone: set[str] = field(default_factory=set)
    """Sides that do not have the link any more."""
    pairing: Pairing | None = None
    """The authentication under way, or the last one."""
    wanting: deque[str] = field(default_factory=deque)
    """Sides whose hosts want another authentication after that."""
    authenticated: bool = False
    """Whether both sides have shown that they have the same key: encryption needs it."""
    encrypted: bool = False
    held: dict[str, deque[tuple[int, bytes]]] = field(init=False)
    """What each side has given and is not on the air yet: (packet boundary, data)."""
    free: dict[str, float] = field(init=False)
    """When each side's sender is free again."""
    due: dict[str, float] = field(init=False)
    """When the last packet arrives at each side."""

    def __post_init__(self) -> None:
        self.held = {address: deque() for address in self.ends}
        self.free = dict.fromkeys(self.ends, 0.0)
        self.due = dict.fromkeys(self.ends, 0.0)

    def peer(self, address: str) -> str:
        """The other side."""
        one, other = self.ends
        return other if address == one else one
