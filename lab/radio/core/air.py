"""The air: who hears whom, how long packets take, and how links begin and end. Virtual time; no IO.

`receive` takes what a host gave its controller, `handle_timer` what time brings about; `to_send` gives the packets for
the hosts, in order. A link over which nothing gets through keeps its packets, as a radio that repeats them for ever,
until either it is heard again or the supervision time-out ends it on both sides.
"""

import heapq
import itertools
import math
from collections import Counter, deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass

from lab.radio.core import hci
from lab.radio.core.controller import Controller
from lab.radio.core.hci import Acl, Command, Status
from lab.radio.core.link import Link


@dataclass
class Medium:
    """How the radio is; may be changed at any time."""

    latency: float = 0.0
    """s one way, after a packet has left."""
    jitter: float = 0.0
    """s; up to so much more, evenly spread; the order stays."""
    bandwidth: float = 0.0
    """bytes/s a link and direction; 0: no limit."""
    page: float = 0.05
    """s until a robot that listens has heard a page."""
    supervision: float = 20.0
    """s without a sign of the other side until a link is over (the standard's default); a host may ask for less."""
    rssi: int = 0
    """dB, of every link; 0: within the golden range."""
    range: float = math.inf
    """m; robots that are placed hear each other so far."""


class Air:
    """All controllers and their links."""

    def __init__(self, uniform: Callable[[], float], new_key: Callable[[], bytes]) -> None:
        """`uniform` draws from [0, 1), `new_key` a link key of 16 bytes."""
        self.medium = Medium()
        self.counts: Counter[str] = Counter()
        self.new_key = new_key
        self._uniform = uniform
        self._controllers: dict[str, Controller] = {}
        self._links: list[Link] = []
        self._cut: set[frozenset[str]] = set()
        self._out: set[str] = set()
        self._places: dict[str, tuple[float, float]] = {}
        self._timers: list[tuple[float, int, Callable[[float], None]]] = []
        self._sequence = itertools.count()
        self._sending: deque[tuple[str, bytes]] = deque()

    # -- the hosts' side -------------------------------------------------------------------------------------

    def add(self, address: str) -> None:
        """A controller is plugged in; one with that address must not be there."""
        if address in self._controllers:
            raise ValueError(f"controller {address} is there already")
        self._controllers[address] = Controller(self, address, len(self._controllers))

    def remove(self, address: str, now: float) -> None:
        """A controller is gone, and with it its links, pages and inquiries; the others find out by the supervision
        time-out."""
        self._controllers.pop(address).switch_off(now)

    def switch_off(self, address: str, now: float) -> None:
        """A controller's host has switched it off; its settings are gone, and the others find out as by `remove`."""
        self._controllers[address].switch_off(now)

    def receive(self, address: str, packet: bytes, now: float) -> None:
        """A packet of the host of that controller; raises hci.HciError."""
        controller = self._controllers[address]
        match hci.parse(packet):
            case Command(op, parameters):
                controller.command(op, parameters, now)
            case Acl(handle, boundary, data):
                link = controller.links.get(handle)
                if link is not None:
                    link.held[controller.address].append((boundary, data))
                    self._pass_on(link, now)

    def to_send(self) -> list[tuple[str, bytes]]:
        """(address, packet) for the hosts, in order."""
        packets = list(self._sending)
        self._sending.clear()
        return packets

    def next_deadline(self) -> float | None:
        """When `handle_timer` is due."""
        return self._timers[0][0] if self._timers else None

    def handle_timer(self, now: float) -> None:
        """All that is due."""
        while self._timers and self._timers[0][0] <= now:
            due, _, action = heapq.heappop(self._timers)
            action(due)

    # -- what tests do ---------------------------------------------------------------------------------------

    def cut(self, one: str, other: str, now: float) -> None:
        """Nothing gets through between these two."""
        self._cut.add(frozenset((one, other)))
        self.heed(now)

    def mend(self, one: str, other: str, now: float) -> None:
        """The end of a cut."""
        self._cut.discard(frozenset((one, other)))
        self.heed(now)

    def topology(self, edges: Iterable[tuple[str, str]], now: float) -> None:
        """Only these hear each other: all others are cut."""
        heard = {frozenset(edge) for edge in edges}
        self._cut = {frozenset(pair) for pair in itertools.combinations(self._controllers, 2)} - heard
        self.heed(now)

    def silence(self, address: str, now: float) -> None:
        """Nothing gets through between this one and anybody."""
        self._out.add(address)
        self.heed(now)

    def unsilence(self, address: str, now: float) -> None:
        """The end of a silence."""
        self._out.discard(address)
        self.heed(now)

    def place(self, address: str, x: float, y: float, now: float) -> None:
        """Put a robot somewhere, m; who is nowhere hears everybody."""
        self._places[address] = (x, y)
        self.heed(now)

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

    # -- for controllers -------------------------------------------------------------------------------------

    def send(self, address: str, packet: bytes) -> None:
        """A packet for the host of that controller."""
        self._sending.append((address, packet))

    def at(self, time: float, action: Callable[[float], None]) -> None:
        """Call back at that time."""
        heapq.heappush(self._timers, (time, next(self._sequence), action))

    def find(self, address: str) -> Controller | None:
        """The controller with that address."""
        return self._controllers.get(address)

    def others(self, me: Controller) -> list[Controller]:
        """The controllers that this one hears."""
        return [each for each in self._controllers.values() if each is not me and self.hears(me.address, each.address)]

    def connect(self, caller: Controller, called: Controller) -> None:
        """A page was accepted: both have the link."""
        link = Link({each.address: each.new_handle() for each in (caller, called)}, caller.address)
        self._links.append(link)
        for each in (called, caller):
            each.links[link.ends[each.address]] = link
            self.send(each.address, hci.connected(0, link.ends[each.address], link.peer(each.address)))
        self.counts["connected"] += 1

    def switch_roles(self, link: Link, central: str) -> None:
        """The other side of a link becomes its central, or the same one stays it; both hosts hear of it."""
        link.central = central
        for address in link.ends:
            if address not in link.gone:
                self.send(address, hci.role_changed(link.peer(address), peripheral=address != central))
        self.counts["roles_switched"] += 1

    def disconnect(self, controller: Controller, link: Link, reason: int, now: float) -> None:
        """One side's host ends the link; the other one hears of it, or finds out in the end."""
        handle = link.ends[controller.address]
        self.send(controller.address, hci.disconnected(handle, Status.LOCAL_HOST_TERMINATED))
        controller.links.pop(handle)
        self._leave(link, controller.address, reason, now)

    def forget(self, controller: Controller, now: float) -> None:
        """The controller is reset or gone: it knows no link any more and says nothing to the others."""
        for link in controller.links.values():
            link.gone.add(controller.address)
            self._watch(link, now)
        controller.links.clear()

    def heed(self, now: float) -> None:
        """Who hears whom may have changed."""
        for link in list(self._links):
            one, other = link.ends
            if link.gone or not self.hears(one, other):
                self._watch(link, now)
            else:
                link.silent_since = None
                self._pass_on(link, now)

    # -- inside ----------------------------------------------------------------------------------------------

    def _watch(self, link: Link, now: float) -> None:
        """From now on nothing gets through; the link ends if it stays so."""
        if link.silent_since is None:
            link.silent_since = now

            def over(_: float) -> None:
                if link.silent_since == now and link in self._links:
                    self._end(link, Status.CONNECTION_TIMEOUT)

            self.at(now + min(self.medium.supervision, link.supervision), over)

    def _end(self, link: Link, reason: int) -> None:
        """The link ends for all that still have it."""
        self._links.remove(link)
        for address, handle in link.ends.items():
            controller = self._controllers.get(address)
            if address not in link.gone and controller is not None:
                controller.links.pop(handle, None)
                self.send(address, hci.disconnected(handle, reason))
        self.counts["lost"] += reason == Status.CONNECTION_TIMEOUT

    def _leave(self, link: Link, address: str, reason: int, now: float) -> None:
        link.gone.add(address)
        peer = link.peer(address)
        if len(link.gone) == 2 or peer not in self._controllers:
            self._links.remove(link)
        elif self.hears(address, peer):
            # After what is on its way already.
            def over(_: float) -> None:
                if link in self._links:
                    self._end(link, reason)

            self.at(max(now, link.due[peer]), over)
        else:
            self._watch(link, now)

    def _pass_on(self, link: Link, now: float) -> None:
        """Put on the air what is held, where anything gets through."""
        if link.silent_since is not None:
            return
        for sender, held in link.held.items():
            receiver = link.peer(sender)
            while held:
                boundary, data = held.popleft()
                self.counts["packets"] += 1
                self.counts["bytes"] += len(data)
                medium = self.medium
                start = max(now, link.free[sender])
                left = start + (len(data) / medium.bandwidth if medium.bandwidth else 0.0)
                there = left + medium.latency + medium.jitter * (self._uniform() if medium.jitter else 0.0)
                link.free[sender], link.due[receiver] = left, max(link.due[receiver], there)
                self._give(left, now, link, sender, hci.completed(link.ends[sender]))
                packet = hci.acl(link.ends[receiver], boundary, data)
                self._give(link.due[receiver], now, link, receiver, packet)

    def _give(self, time: float, now: float, link: Link, address: str, packet: bytes) -> None:
        """A packet for that side of a link at that time, where it still has the link."""

        def give(_: float) -> None:
            if link in self._links and address not in link.gone:
                self.send(address, packet)

        if time <= now:
            give(now)
        else:
            self.at(time, give)
