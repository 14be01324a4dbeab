"""What the air knows of one link between two controllers."""

import math
from collections import deque
from dataclasses import dataclass, field

from lab.radio.core.pairing import Pairing
from sim.slots.devices import RadioLink


@dataclass(eq=False)
class Link:
    """An ACL link. All dictionaries are by the address of a controller."""

    ends: dict[str, int]
    """The handle that each side has for it; they differ."""
    radio: RadioLink
    """The same in the slots of the radio."""
    supervision: float = math.inf
    """s without a sign of the other side until the link is over, as set by that side's host."""
    gone: set[str] = field(default_factory=set)
    """Sides that do not have the link any more."""
    closing: set[str] = field(default_factory=set)
    """Sides whose hosts have ended it, of which the other side has not heard yet."""
    pairing: Pairing | None = None
    """The authentication under way, or the last one."""
    wanting: deque[str] = field(default_factory=deque)
    """Sides whose hosts want another authentication after that."""
    authenticated: bool = False
    """Whether both sides have shown that they have the same key: encryption needs it."""
    encrypted: bool = False

    @property
    def central(self) -> str:
        """The side that has paged, where no host has had the roles switched; it alone sets the supervision time-out."""
        return self.radio.central.device.name

    def peer(self, address: str) -> str:
        """The other side."""
        one, other = self.ends
        return other if address == one else one
