"""The air: who hears whom, and how links begin and end, over the slots of a Bluetooth radio (`sim.slots`). No IO.

`receive` takes what a host gave its controller, `handle_timer` what time brings about; `to_send` gives the packets for
the hosts, in order. The slots pass in virtual time, which follows the times that those are given. A link over which
nothing gets through keeps its packets, until either it is heard again or the supervision time-out ends it on both
sides.
"""

import dataclasses
import itertools
import math
from collections import Counter, deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from typing import Any

from lab.radio.core import hci
from lab.radio.core.controller import Controller
from lab.radio.core.hci import Acl, Command, Status
from lab.radio.core.link import Link
from sim.slots.calls import SMALL, Calls
from sim.slots.devices import RadioDevice, RadioLink
from sim.slots.parameters import OVERHEAD, SlotParameters
from sim.slots.radio import SlotRadio
from sim.virtual.events import EventQueue
from swarm.core.random_numbers import RandomNumbers

PARAMETERS = SlotParameters(host=0.0, setup=6, page_timeout=41.0)
"""Of the slot radio. Hosts are real: they take their own time, set their own page time-out, and exchange the frames of
L2CAP and RFCOMM themselves, which leaves those of the link managers."""


@dataclass(frozen=True)
class Medium:
    """How the radio is, beside its slots."""

    supervision: float = 20.0
    """s without a sign of the other side until a link is over (the standard's default); a host may ask for less."""
    rssi: int = 0
    """dB, of every link; 0: within the golden range."""
    range: float = math.inf
    """m; robots that are placed hear each other so far."""


class Air:
    """All controllers and their links."""

    def __init__(self, random: RandomNumbers, new_key: Callable[[], bytes]) -> None:
        """`new_key` draws a link key of 16 bytes."""
        self.medium = Medium()
        self.counts: Counter[str] = Counter()
        self.new_key = new_key
        self._time = EventQueue()
        self._radio = SlotRadio(self._time, (), PARAMETERS, random)
        self._radio.passes = self.hears
        self.calls = Calls(self._time, self._radio)
        self._controllers: dict[str, Controller] = {}
        self._links: list[Link] = []
        self._cut: set[frozenset[str]] = set()
        self._out: set[str] = set()
        self._places: dict[str, tuple[float, float]] = {}
        self._sending: deque[tuple[str, bytes]] = deque()

    # -- the hosts' side -------------------------------------------------------------------------------------

    def add(self, address: str) -> None:
        """A controller is plugged in; one with that address must not be there."""
        if address in self._controllers:
            raise ValueError(f"controller {address} is there already")
        if address not in self._radio.devices:
            self._radio.devices[address] = RadioDevice(address)
            self.calls.add(address)
        self._controllers[address] = Controller(self, address, len(self._controllers))

    def remove(self, address: str) -> None:
        """A controller is gone, and with it its links, pages and inquiries; the others find out by the supervision
        time-out."""
        self._controllers.pop(address).switch_off()

    def switch_off(self, address: str) -> None:
        """A controller's host has switched it off; its settings are gone, and the others find out as by `remove`."""
        self._controllers[address].switch_off()

    def receive(self, address: str, packet: bytes, now: float) -> None:
        """A packet of the host of that controller; raises hci.HciError."""
        self._time.run(now)
        controller = self._controllers[address]
        match hci.parse(packet):
            case Command(op, parameters):
                controller.command(op, parameters)
            case Acl(handle, boundary, data):
                link = controller.links.get(handle)
                if link is not None:
                    self._carry(link, address, boundary, data)
        self._time.run(now)

    def to_send(self) -> list[tuple[str, bytes]]:
        """(address, packet) for the hosts, in order."""
        packets = list(self._sending)
        self._sending.clear()
        return packets

    def next_deadline(self) -> float:
        """When `handle_timer` is due; infinity where nothing is."""
        return self._time.next_time

    def handle_timer(self, now: float) -> None:
        """All that is due."""
        self._time.run(now)

    # -- what tests do ---------------------------------------------------------------------------------------

    def cut(self, one: str, other: str) -> None:
        """Nothing gets through between these two."""
        self._cut.add(frozenset((one, other)))

    def mend(self, one: str, other: str) -> None:
        """The end of a cut."""
        self._cut.discard(frozenset((one, other)))

    def topology(self, edges: Iterable[tuple[str, str]]) -> None:
        """Only these hear each other: all others are cut."""
        heard = {frozenset(edge) for edge in edges}
        self._cut = {frozenset(pair) for pair in itertools.combinations(self._controllers, 2)} - heard

    def silence(self, address: str) -> None:
        """Nothing gets through between this one and anybody."""
        self._out.add(address)

    def unsilence(self, address: str) -> None:
        """The end of a silence."""
        self._out.discard(address)

    def place(self, address: str, x: float, y: float) -> None:
        """Put a robot somewhere, m; who is nowhere hears everybody."""
        self._places[address] = (x, y)

    def change(self, **values: Any) -> None:
        """Change the medium; see `Medium`."""
        self.medium = dataclasses.replace(self.medium, **values)
        for link in self._links:
            self.supervise(link)

    def drop(self, one: str, other: str) -> None:
        """The link of these two ends at once, as by its supervision time-out."""
        for link in [link for link in self._links if set(link.ends) == {one, other}]:
            self._end(link, Status.CONNECTION_TIMEOUT)

    def hears(self, one: str, other: str) -> bool:
        """Whether packets get through between these two."""
        if frozenset((one, other)) in self._cut or self._out & {one, other}:
            return False
        if one in self._places and other in self._places:
            return math.dist(self._places[one], self._places[other]) <= self.medium.range
        return True

    def links(self) -> list[tuple[str, str]]:
        """The pairs that have a link, sorted."""
        return sorted((min(link.ends), max(link.ends)) for link in self._links)

    def encrypted(self) -> list[tuple[str, str]]:
        """The pairs whose link is encrypted, sorted."""
        return sorted((min(link.ends), max(link.ends)) for link in self._links if link.encrypted)

    def scans(self) -> dict[str, float]:
        """Seconds between two page scans of each controller, as its host has set it; it may scan or not."""
        return {address: self.calls.scans[address][0] for address in self._controllers}

    # -- for controllers -------------------------------------------------------------------------------------

    def send(self, address: str, packet: bytes) -> None:
        """A packet for the host of that controller."""
        self._sending.append((address, packet))

    def after(self, seconds: float, action: Callable[[], object]) -> None:
        """Call back after so long."""
        self._time.at(self._time.now + seconds, action)

    def find(self, address: str) -> Controller | None:
        """The controller with that address."""
        return self._controllers.get(address)

    def others(self, me: Controller) -> list[Controller]:
        """The controllers that this one hears."""
        return [each for each in self._controllers.values() if each is not me and self.hears(me.address, each.address)]

    def listen(self, address: str, scans: tuple[float, float], *, on: bool) -> None:
        """That controller scans for pages each so many seconds, for so long; or would, if it were `on`."""
        self.calls.scans[address] = scans
        (self.calls.reachable.add if on else self.calls.reachable.discard)(address)

    def connect(self, caller: Controller, called: Controller, radio: RadioLink) -> None:
        """A call was accepted: both have the link."""
        link = Link({each.address: each.new_handle() for each in (caller, called)}, radio)
        self._links.append(link)
        radio.lost = partial(self._end, link, Status.CONNECTION_TIMEOUT)
        self.supervise(link)
        for each in (called, caller):
            each.links[link.ends[each.address]] = link
            self.send(each.address, hci.connected(0, link.ends[each.address], link.peer(each.address)))
        self.counts["connected"] += 1

    def refuse(self, radio: RadioLink) -> None:
        """A call was not accepted: the radio has the link no more."""
        self._radio.drop(radio)

    def supervise(self, link: Link) -> None:
        """Let a link be over after as much silence as its central and the medium say."""
        self._radio.supervise(link.radio, min(self.medium.supervision, link.supervision))

    def switch_roles(self, link: Link, asking: str, central: str) -> None:
        """That side of a link becomes its central, or stays it; both hosts hear of it when the other side has."""

        def switched() -> None:
            if link.central != central:
                self._radio.switch_roles(link.radio)
            for address in link.ends:
                if address not in link.gone:
                    self.send(address, hci.role_changed(link.peer(address), peripheral=address != central))
            self.counts["roles_switched"] += 1

        self._radio.send(link.radio, asking, SMALL, switched)

    def disconnect(self, controller: Controller, link: Link, reason: int) -> None:
        """One side's host ends the link: that comes after the data before it, and then both hosts hear of it."""
        link.closing.add(controller.address)
        self._radio.send(link.radio, controller.address, SMALL, lambda: self._end(link, reason))

    def forget(self, controller: Controller) -> None:
        """The controller is reset or gone: it knows no link any more and says nothing to the others."""
        for link in controller.links.values():
            link.gone.add(controller.address)
        controller.links.clear()
        self._radio.switch_off(controller.address)

    # -- inside ----------------------------------------------------------------------------------------------

    def _carry(self, link: Link, sender: str, boundary: int, data: bytes) -> None:
        """Put a packet of data on the air. Its buffer is free when it is there."""
        receiver = link.peer(sender)

        def arrived() -> None:
            for address, packet in (
                (sender, hci.completed(link.ends[sender])),
                (receiver, hci.acl(link.ends[receiver], boundary, data)),
            ):
                if address not in link.gone:
                    self.send(address, packet)

        self.counts["packets"] += 1
        self.counts["bytes"] += len(data)
        self._radio.send(link.radio, sender, max(len(data) - OVERHEAD, 1), arrived)

    def _end(self, link: Link, reason: int) -> None:
        """The link ends for all that still have it."""
        self._links.remove(link)
        self._radio.drop(link.radio)
        for address, handle in link.ends.items():
            if address not in link.gone:
                self._controllers[address].links.pop(handle)
                code = Status.LOCAL_HOST_TERMINATED if address in link.closing else reason
                self.send(address, hci.disconnected(handle, code))
        self.counts["lost"] += reason == Status.CONNECTION_TIMEOUT
