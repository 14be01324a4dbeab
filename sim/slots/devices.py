"""The devices of a slot radio and the links between them: what each holds and what it is doing, as `radio` changes it.

A device is the controller of one robot. A link has two ends, each with the frames that its device has to send there.
"""

from collections import deque
from collections.abc import Callable

from sim.slots.parameters import EDR2

PAGE = ""
"""Name of the role of paging, to which a device is tuned. A piconet has its central's name."""

ABOUT = 1e-9
"""Seconds by which sums of slots may be off."""

_NEVER = float("inf")


class RadioFrame:
    """Bytes that are to arrive at the other end as a whole."""

    def __init__(self, size: int, arrived: Callable[[], None]) -> None:
        self.size = self.left = size
        self.arrived = arrived


class LinkEnd:
    """The frames that one end of a link has to send."""

    def __init__(self, device: "RadioDevice", now: float) -> None:
        self.device = device
        self.waiting: deque[RadioFrame] = deque()
        """Frames in the host."""
        self.held: deque[RadioFrame] = deque()
        """Frames in the controller."""
        self.got = False
        """Whether the packet at the head has arrived and its acknowledgement has not."""
        self.heard = now
        """The time at which this end last heard the other one."""
        self.ready_at = self.delivered_at = now
        """The time at which the host had the last frame ready for sending, and the last one received."""

    def packet(self) -> tuple[int, int]:
        """Return the bytes and slots of the next packet."""
        if not self.held:
            return 0, 1
        left = self.held[0].left
        return next(((left, slots) for size, slots in EDR2 if left <= size), EDR2[-1])


class RadioLink:
    """One link of the baseband."""

    def __init__(self, central: LinkEnd, peripheral: LinkEnd, now: float) -> None:
        self.central, self.peripheral = central, peripheral
        self.supervision = 0.0
        self.watch = 0
        """Counts plans of `SlotRadio.supervise`."""
        self.polled = now - 1.0
        self.used = now
        """The time at which it last carried data."""
        self.misses = 0
        self.more = False
        """Whether the peripheral has said that it has more."""
        self.up = True
        self.lost: Callable[[], None] = lambda: None
        """Called when the link is lost."""

    def end(self, name: str) -> LinkEnd:
        """Return the end of a device."""
        return self.central if self.central.device.name == name else self.peripheral


class RadioDevice:
    """The controller of one robot."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.roles: list[str] = []
        """The roles among which it shares its time: piconets, and `PAGE`."""
        self.tuned: str | None = None
        self.ready = 0.0
        """The time at which the change to that role is done."""
        self.until = _NEVER
        """The time at which the stay ends."""
        self.scanning = 0.0
        """The time until which it scans for pages."""
        self.busy = 0.0
        """The time until which an exchange takes it."""
        self.links: list[RadioLink] = []
        self.central_of: list[RadioLink] = []
        self.turn = 0
        self.held = 0
        """Frames in its buffers."""
        self.polled: set[RadioLink] = set()
        """The links that it has polled in this stay."""
        self.serving = self.switching = 0
        """Numbers of plans. A plan that another one has replaced does nothing."""

    def is_in(self, piconet: str, now: float) -> bool:
        """Return whether it hears that piconet now."""
        return self.tuned == piconet and max(self.ready, self.scanning, self.busy) <= now + ABOUT
