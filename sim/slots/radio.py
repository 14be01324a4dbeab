"""Links of a slot radio: which device is in which piconet when, and what a central and its peripherals exchange there.

A device is tuned to one thing at a time: a piconet (its own or one in which it is a peripheral), its pages, or nothing
(guard slots at each change, page scans). A link carries data while both its ends are in the central's piconet. Nobody
knows of the others' rounds: Linux negotiates no sniff mode, and how a controller shares its time is its own affair.

The central begins in even slots. It serves links with data in turn, polls the others at an interval and whoever it has
not polled in this stay, and asks those that do not answer less and less often. An exchange is a packet down and one up,
each the smallest that holds what is there; what was not acknowledged is sent again (ARQ, Core specification, vol 2 part
B, 7.6). So a link delivers every byte in order, or is lost.
"""

import math
from collections.abc import Callable, Iterable
from typing import Any, Protocol

from sim.slots.devices import ABOUT, PAGE, LinkEnd, RadioDevice, RadioFrame, RadioLink
from sim.slots.parameters import MAX_PERIPHERALS, OVERHEAD, SLOT, SlotParameters
from swarm.core.random_numbers import RandomNumbers

EVEN = 2 * SLOT

TRIED = 2
"""Times that a peripheral may be silent until it is asked less often; then the pause doubles up to `RAREST`."""
RAREST = 16
"""Longest pause between two polls of a peripheral that is silent, in pairs of slots."""

_NEVER = float("inf")


def _even(time: float) -> float:
    """Return the first even slot that begins at `time` or later."""
    return math.ceil(time / EVEN - ABOUT) * EVEN


class EventClock(Protocol):
    """Time that calls back, in the order of times and of planning."""

    now: float

    def at(self, time: float, call: Callable[..., object], *arguments: Any) -> None:
        """Call at `time`."""


class SlotRadio:
    """The links of all robots."""

    def __init__(
        self, clock: EventClock, names: Iterable[str], parameters: SlotParameters, random: RandomNumbers
    ) -> None:
        self._clock = clock
        self.parameters = parameters
        self.random = random
        self.devices = {name: RadioDevice(name) for name in names}
        self.passes: Callable[[str, str], bool] = lambda a, b: True
        """Whether two robots hear each other."""
        self.losses: dict[frozenset[str], float] = {}
        """Probabilities, as `SlotParameters.loss`, between pairs of robots that differ from it."""

    def switch_off(self, name: str) -> None:
        """Let a device fall silent without a word: the others lose its links by supervision. From now on its name is
        that of a new one without links."""
        device = self.devices[name]
        device.roles.clear()
        device.tuned = None
        device.switching += 1
        device.serving += 1
        self.devices[name] = RadioDevice(name)

    # -- links -------------------------------------------------------------------------------------------------

    def has_room(self, name: str) -> bool:
        """Return whether a central can have one more peripheral."""
        return len(self.devices[name].central_of) < MAX_PERIPHERALS

    def connect(self, central: str, peripheral: str) -> RadioLink:
        """Make a link that is there from now on."""
        now = self._clock.now
        c, p = self.devices[central], self.devices[peripheral]
        link = RadioLink(LinkEnd(c, now), LinkEnd(p, now), now)
        for device in (c, p):
            device.links.append(link)
            self.take_role(device, central)
        c.central_of.append(link)
        self._wake(c)
        self.supervise(link, self.parameters.supervision)
        return link

    def supervise(self, link: RadioLink, seconds: float) -> None:
        """Give a link up after so many seconds of silence, as its caller may wish."""
        link.supervision = seconds
        link.watch += 1
        self._watch(link, link.watch)

    def be_central(self, name: str, link: RadioLink) -> None:
        """Make a device the central of a link of its own, where it is not yet and has room."""
        if link.up and link.peripheral.device.name == name and self.has_room(name):
            self.switch_roles(link)

    def switch_roles(self, link: RadioLink) -> None:
        """Make the peripheral the central of a link; what its ends hold stays. It must have room."""
        before, after = link.central.device, link.peripheral.device
        link.central, link.peripheral = link.peripheral, link.central
        before.central_of.remove(link)
        after.central_of.append(link)
        for device in (before, after):
            self.take_role(device, after.name)
        self.leave_role(after, before.name)
        if not before.central_of:
            self.leave_role(before, before.name)
        self._wake(after)

    def drop(self, link: RadioLink) -> None:
        """Remove a link; the frames that it held are lost."""
        if not link.up:
            return
        link.up = False
        c, p = link.central.device, link.peripheral.device
        c.central_of.remove(link)
        for end in (link.central, link.peripheral):
            end.device.links.remove(link)
            end.device.held -= len(end.held)
            self._refill(end.device)
        if not c.central_of:
            self.leave_role(c, c.name)
        if all(each.central.device.name != c.name for each in p.links):  # else with a new device of that name
            self.leave_role(p, c.name)

    def send(self, link: RadioLink, sender: str, size: int, arrived: Callable[[], None]) -> None:
        """Send a frame of so many bytes; `arrived()` is called when the other end's host has it, unless the link is
        lost before."""
        end = link.end(sender)
        frame = RadioFrame(size + OVERHEAD, arrived)
        end.ready_at = max(end.ready_at, self._clock.now + self._host(frame.size))
        self._clock.at(end.ready_at, self._hand_over, link, end, frame)

    def _watch(self, link: RadioLink, plan: int) -> None:
        if link.up and plan == link.watch:
            ends_at = min(link.central.heard, link.peripheral.heard) + link.supervision
            if self._clock.now < ends_at:
                self._clock.at(ends_at, self._watch, link, plan)
            else:
                self.drop(link)
                link.lost()

    # -- the host ----------------------------------------------------------------------------------------------

    def _host(self, size: int) -> float:
        p = self.parameters
        return p.host * (1.0 + p.host_spread * (2.0 * self.random.random() - 1.0)) + size * 10.0 / p.uart

    def _hand_over(self, link: RadioLink, end: LinkEnd, frame: RadioFrame) -> None:
        if link.up:
            end.waiting.append(frame)
            self._refill(end.device)

    def _refill(self, device: RadioDevice) -> None:
        """The host hands frames over as buffers are free, to the link with the fewest first (Linux, hci_low_sent)."""
        while device.held < self.parameters.buffers:
            ends = [(link, link.end(device.name)) for link in device.links]
            ready = [(link, end) for link, end in ends if end.waiting]
            if not ready:
                return
            link, end = min(ready, key=lambda each: len(each[1].held))
            end.held.append(end.waiting.popleft())
            device.held += 1
            if link.central is end and device.tuned == device.name:
                self._wake(device)

    # -- where a device is -------------------------------------------------------------------------------------

    def take_role(self, device: RadioDevice, role: str) -> None:
        """Add a role among which a device shares its time. One without power has none."""
        if role in device.roles or self.devices[device.name] is not device:
            return
        device.roles.append(role)
        if len(device.roles) == 1:
            device.tuned, device.ready, device.until = role, self._clock.now, _NEVER
        elif device.until == _NEVER:
            self._stay(device)

    def leave_role(self, device: RadioDevice, role: str) -> None:
        """Remove a role from those among which a device shares its time."""
        if role in device.roles:
            device.roles.remove(role)
            if device.tuned == role:
                device.tuned = None
                self._switch(device, device.switching)

    def _stay(self, device: RadioDevice) -> None:
        p = self.parameters
        weight = (p.page_weight if device.tuned == PAGE else 1.0) * min(1.0, 2.0 / len(device.roles))
        stay = weight * p.stay * (1.0 + p.spread * (2.0 * self.random.random() - 1.0))
        device.until = self._clock.now + stay
        self._clock.at(device.until, self._switch, device, device.switching)

    def _switch(self, device: RadioDevice, plan: int) -> None:
        """Go to the next of its roles, after the exchange that is under way."""
        if plan != device.switching:
            return
        now = self._clock.now
        if device.busy > now + ABOUT:
            self._clock.at(device.busy, self._switch, device, plan)
            return
        device.switching += 1
        before, device.until = device.tuned, _NEVER
        if not device.roles:
            device.tuned = None
            return
        place = device.roles.index(before) + 1 if before in device.roles else 0
        device.tuned = device.roles[place % len(device.roles)]
        device.polled.clear()
        if device.tuned != before:
            device.ready = now + self.parameters.guard * SLOT * (0.5 + 0.5 * self.random.random())
        if len(device.roles) > 1:
            self._stay(device)
        if device.tuned == device.name:
            self._wake(device)

    # -- the central -------------------------------------------------------------------------------------------

    def _wake(self, device: RadioDevice) -> None:
        """Look at the next even slot what is to be done."""
        device.serving += 1
        free = max(self._clock.now, device.ready, device.busy, device.scanning)
        self._clock.at(_even(free), self._serve, device, device.serving)

    def _serve(self, device: RadioDevice, plan: int) -> None:
        if plan != device.serving or device.tuned != device.name:
            return
        now = self._clock.now
        if not device.is_in(device.name, now):
            self._wake(device)
            return
        links, due = device.central_of, _NEVER
        for step in range(len(links)):
            place = (device.turn + step) % len(links)
            at = self._next_poll(device, links[place])
            if at <= now + ABOUT:
                device.turn = (place + 1) % len(links)
                device.busy = self._exchange(links[place])
                self._clock.at(device.busy, self._serve, device, plan)
                return
            due = min(due, at)
        if due < _NEVER:
            # Towards an even slot, or the phase would drift from poll to poll.
            self._clock.at(max(_even(due), now + EVEN), self._serve, device, plan)

    def _next_poll(self, device: RadioDevice, link: RadioLink) -> float:
        p, now = self.parameters, self._clock.now
        waits = bool(link.central.held)
        if waits or link.more or (len(device.roles) > 1 and link not in device.polled):
            if waits and link.misses > TRIED:
                return link.polled + min(1 << link.misses, RAREST) * EVEN
            return now
        return link.polled + (p.poll_busy if now - link.used < p.busy_for else p.poll_idle) * SLOT

    def _lost(self, link: RadioLink, size: int) -> bool:
        loss = self.parameters.loss
        if self.losses:
            loss = self.losses.get(frozenset((link.central.device.name, link.peripheral.device.name)), loss)
        return self.random.random() < (loss if size else loss / 3.0)

    def _exchange(self, link: RadioLink) -> float:
        """Exchange a packet down and one up; return when that is over."""
        now = self._clock.now
        down, up = link.central, link.peripheral
        central, peripheral = down.device, up.device
        link.polled = now
        central.polled.add(link)
        size, slots = down.packet()
        hears = peripheral.is_in(central.name, now) and self.passes(central.name, peripheral.name)
        if not hears or self._lost(link, size):
            link.misses += 1
            return now + (slots + 1) * SLOT
        up.heard = now
        back, back_slots = up.packet()
        end = now + (slots + back_slots) * SLOT
        peripheral.busy = end
        if size:
            self._got(link, down, up, size, now + slots * SLOT)
        if self._lost(link, back):
            link.misses += 1
            return end  # neither data nor the acknowledgement in it has reached the central
        link.misses = 0
        down.heard = now
        if size:
            self._acknowledged(down, size)
        if back:
            self._got(link, up, down, back, end)
            self._acknowledged(up, back)  # by the next poll, whose loss is left out
        if size or back:
            link.used = now
        link.more = bool(up.held)
        return end

    def _got(self, link: RadioLink, sender: LinkEnd, receiver: LinkEnd, size: int, at: float) -> None:
        if sender.got:
            return
        sender.got = True
        frame = sender.held[0]
        if frame.left <= size:
            receiver.delivered_at = max(receiver.delivered_at, at + self._host(frame.size))
            self._clock.at(receiver.delivered_at, self._deliver, link, frame)

    @staticmethod
    def _deliver(link: RadioLink, frame: RadioFrame) -> None:
        if link.up:
            frame.arrived()

    def _acknowledged(self, end: LinkEnd, size: int) -> None:
        end.got = False
        end.held[0].left -= size
        if end.held[0].left <= 0:
            end.held.popleft()
            end.device.held -= 1
            self._refill(end.device)
