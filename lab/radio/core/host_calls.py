"""The calls that one controller's host makes and answers: what is between its commands and the pages of the radio."""

from typing import TYPE_CHECKING

from lab.radio.core import hci
from lab.radio.core.hci import Ev, Status
from sim.slots.calls import ABSENT, BUSY, FULL, LATE, CallAttempt
from sim.slots.devices import RadioLink
from sim.slots.parameters import MAX_PERIPHERALS

if TYPE_CHECKING:
    from lab.radio.core.air import Air
    from lab.radio.core.controller import Controller

MAX_LINKS = MAX_PERIPHERALS
"""Of a controller, whatever its roles in them."""

FAILED = {
    ABSENT: Status.PAGE_TIMEOUT,
    LATE: Status.PAGE_TIMEOUT,
    BUSY: Status.CONNECTION_EXISTS,
    FULL: Status.CONNECTION_LIMIT,
}
"""By the reason why a call made no link."""


class HostCalls:
    """Calls that are under way, by the address of the other side."""

    def __init__(self, air: "Air", me: "Controller") -> None:
        self.made: dict[str, CallAttempt] = {}
        """Those of our host, until the other one has answered."""
        self.received: dict[str, RadioLink] = {}
        """Those that our host has not answered yet."""
        self._air = air
        self._me = me

    def forget(self) -> None:
        """The controller is reset or gone."""
        for call in self.made.values():
            self._give_up(call)
        self.made.clear()
        self.received.clear()

    # -- commands of the host ----------------------------------------------------------------------------------

    def create(self, op: int, parameters: bytes) -> None:
        """Create Connection."""
        address = hci.from_wire(parameters[:6])
        if self._me.link_to(address) is not None or address in self.made:
            self._status(op, Status.CONNECTION_EXISTS)
            return
        self._status(op)
        self.made[address] = self._air.calls.call(
            self._me.address, address, self._me.page_timeout, lambda link, reason: self._paged(address, link, reason)
        )

    def cancel(self, op: int, parameters: bytes) -> None:
        """Create Connection Cancel."""
        address = hci.from_wire(parameters[:6])
        code = Status.SUCCESS if address in self.made else Status.UNKNOWN_CONNECTION
        self._air.send(self._me.address, hci.complete(op, bytes((code,)) + parameters[:6]))
        if address in self.made:
            self._fail(address, Status.UNKNOWN_CONNECTION)

    def accept(self, op: int, parameters: bytes) -> None:
        """Accept Connection Request. It is the answer to a call of our own, too."""
        address = hci.from_wire(parameters[:6])
        link, caller = self.received.pop(address, None), self._air.find(address)
        if link is None or caller is None or not link.up:
            self._status(op, Status.UNKNOWN_CONNECTION)
            return
        self._status(op)
        del caller.calls.made[self._me.address]
        if address in self.made:
            self._give_up(self.made.pop(address))
        self._air.connect(caller, self._me, link)

    def reject(self, op: int, parameters: bytes) -> None:
        """Reject Connection Request. It is the answer to a call of our own, too."""
        address, reason = hci.from_wire(parameters[:6]), parameters[6]
        link, caller = self.received.pop(address, None), self._air.find(address)
        self._status(op)
        self._air.send(self._me.address, hci.connected(reason, 0, address))
        if address in self.made:
            self._give_up(self.made.pop(address))
        if link is not None and caller is not None:
            caller.calls._fail(self._me.address, reason)

    # -- inside ------------------------------------------------------------------------------------------------

    def _status(self, op: int, code: int = Status.SUCCESS) -> None:
        self._air.send(self._me.address, hci.status(op, code))

    def _paged(self, address: str, link: RadioLink | None, reason: str) -> None:
        """The page was heard, and the other host is asked whether it wants a link; or there is none."""
        called, call = self._air.find(address), self.made[address]
        if address in self.received:
            self._give_up(call)  # it has called us meanwhile: the answer to that call is that to ours
        elif link is None:
            self._fail(address, FAILED[reason])
        elif called is None:
            self._fail(address, Status.PAGE_TIMEOUT)
        elif len(self._me.links) >= MAX_LINKS:
            self._fail(address, Status.CONNECTION_LIMIT)
        elif len(called.links) >= MAX_LINKS:
            self._fail(address, Status.LIMITED_RESOURCES)
        elif called.link_to(self._me.address) is not None:
            # It has not noticed yet that we have lost our end.
            self._fail(address, Status.CONNECTION_EXISTS)
        else:
            link.lost = lambda: self._fail(address, Status.CONNECTION_TIMEOUT)
            called.calls.received[self._me.address] = link
            ours = hci.to_wire(self._me.address) + self._me.device_class + b"\x01"
            self._air.send(address, hci.event(Ev.CONNECTION_REQUEST, ours))
            self._air.after(self._me.page_timeout, lambda: self._not_answered(address, call))

    def _not_answered(self, address: str, call: CallAttempt) -> None:
        if self.made.get(address) is call:
            self._fail(address, Status.ACCEPT_TIMEOUT)

    def _fail(self, address: str, code: int) -> None:
        self._give_up(self.made.pop(address))
        self._air.counts["page_timeouts"] += code == Status.PAGE_TIMEOUT
        self._air.send(self._me.address, hci.connected(code, 0, address))
        called = self._air.find(address)
        rang = called is not None and called.calls.received.pop(self._me.address, None) is not None
        if called is not None and rang and self._me.address in called.calls.made:
            called.calls._fail(self._me.address, code)

    def _give_up(self, call: CallAttempt) -> None:
        self._air.calls.cancel(call)
        if call.link is not None:
            self._air.refuse(call.link)
