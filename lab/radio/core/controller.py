"""One BR/EDR controller: what it answers to each command of its host."""

import struct
from collections.abc import Callable
from typing import TYPE_CHECKING

from lab.radio.core import hci
from lab.radio.core.answers import ANSWERED, COMPANY, ENCRYPTION_KEY_SIZE, FEATURES, OF_A_LINK, PAIRING, RSSI, VERSION
from lab.radio.core.hci import Ev, Op, Status
from lab.radio.core.host_calls import HostCalls
from lab.radio.core.link import Link
from lab.radio.core.pairing import Pairing
from sim.slots.parameters import SLOT

if TYPE_CHECKING:
    from lab.radio.core.air import Air

INQUIRY_SCAN, PAGE_SCAN = 1, 2
"""Bits of the scan enable setting: can be found, can be connected to."""

PAGE_SCANS = struct.pack("<HH", 0x0800, 0x0012)
"""Slots between two page scans, and of one, unless the host sets others (vol 4 part E, 7.3.19)."""

INQUIRY_UNIT = 1.28
"""s."""

NAME_TIME = 0.05
"""s until a robot has said its name."""


class Controller:
    """One controller, and what its host has set in it."""

    def __init__(self, air: "Air", address: str, number: int) -> None:
        self.address = address
        self.links: dict[int, Link] = {}
        """By handle."""
        self.calls = HostCalls(air, self)
        self._air = air
        # Handles differ between controllers, so that no test passes by their being equal.
        self._next_handle = 1 + 64 * number
        # Of the last inquiry that began or was cancelled: what an earlier one still has to tell is not told.
        self._inquiry_number = 0
        self._set_defaults()
        self._handlers: dict[int, Callable[[int, bytes], None]] = {
            Op.RESET: self._reset,
            Op.INQUIRY: self._inquiry,
            Op.INQUIRY_CANCEL: self._inquiry_cancel,
            Op.CREATE_CONNECTION: self.calls.create,
            Op.CREATE_CONNECTION_CANCEL: self.calls.cancel,
            Op.ACCEPT_CONNECTION: self.calls.accept,
            Op.REJECT_CONNECTION: self.calls.reject,
            Op.DISCONNECT: self._disconnect,
            Op.REMOTE_NAME: self._remote_name,
            Op.AUTHENTICATION_REQUESTED: self._authenticate,
            Op.SET_ENCRYPTION: self._encrypt,
            Op.WRITE_NAME: self._write,
            Op.WRITE_SCAN: self._write,
            Op.WRITE_PAGE_SCAN_ACTIVITY: self._write,
            Op.WRITE_PAGE_SCAN_TYPE: self._write,
            Op.WRITE_CLASS: self._write,
            Op.WRITE_SIMPLE_PAIRING: self._write,
            Op.WRITE_PAGE_TIMEOUT: self._write,
            Op.WRITE_SUPERVISION: self._supervise,
            Op.SWITCH_ROLE: self._switch_role,
            Op.ROLE_DISCOVERY: self._tell_role,
            Op.READ_RSSI: self._tell_rssi,
        }

    def _set_defaults(self) -> None:
        self.scan = 0
        self._page_scans = PAGE_SCANS
        self._page_scan_type = 0
        self._listen()
        self.device_class = bytes(3)
        self.name = b"lab".ljust(248, b"\0")
        self.simple_pairing = 0
        self.page_timeout = 0x2000 * SLOT

    def _listen(self) -> None:
        """Have the radio scan for pages as the host has set it; an interlaced scan takes twice as long."""
        interval, window = struct.unpack("<HH", self._page_scans)
        times = interval * SLOT, min(window * (1 + self._page_scan_type), interval) * SLOT
        self._air.listen(self.address, times, on=bool(self.scan & PAGE_SCAN))

    def new_handle(self) -> int:
        """A handle that no link of ours has."""
        while self._next_handle in self.links:
            self._next_handle += 1
        self._next_handle += 1
        return self._next_handle - 1

    def link_to(self, address: str) -> Link | None:
        """Our link to that controller."""
        return next((link for link in self.links.values() if link.peer(self.address) == address), None)

    def command(self, op: int, parameters: bytes) -> None:
        """Do what the host wants and answer it."""
        if op in self._handlers:
            self._handlers[op](op, parameters)
        elif op in PAIRING:
            self._pairing(op, parameters)
        elif op in ANSWERED:
            self._complete(op, ANSWERED[op])
        elif op in OF_A_LINK:
            self._complete(op, b"\0" + parameters[:2] + OF_A_LINK[op])
        elif (result := self._read(op, parameters)) is not None:
            self._complete(op, b"\0" + result)
        elif (end := self._of_link(op, parameters)) is not None:
            self._status(op)
            self._event(*end)
        else:
            self._air.counts[f"unknown_{op:04x}"] += 1
            self._complete(op, bytes((Status.UNKNOWN_COMMAND,)))

    # -- answers ---------------------------------------------------------------------------------------------

    def _event(self, code: int, body: bytes) -> None:
        self._air.send(self.address, hci.event(code, body))

    def _complete(self, op: int, result: bytes = b"\0") -> None:
        self._air.send(self.address, hci.complete(op, result))

    def _status(self, op: int, code: int = Status.SUCCESS) -> None:
        self._air.send(self.address, hci.status(op, code))

    def _read(self, op: int, parameters: bytes) -> bytes | None:
        """The result, after its status, of a command that only reads."""
        match op:
            case Op.READ_ADDRESS:
                return hci.to_wire(self.address)
            case Op.READ_NAME:
                return self.name
            case Op.READ_SCAN:
                return bytes((self.scan,))
            case Op.READ_PAGE_SCAN_ACTIVITY:
                return self._page_scans
            case Op.READ_PAGE_SCAN_TYPE:
                return bytes((self._page_scan_type,))
            case Op.READ_CLASS:
                return self.device_class
            case Op.READ_SIMPLE_PAIRING:
                return bytes((self.simple_pairing,))
            case Op.READ_EXTENDED_FEATURES:
                host = bytes((self.simple_pairing,)) + bytes(7)
                return bytes((parameters[0], 1)) + (host if parameters[0] else FEATURES)
            case Op.READ_KEY_SIZE:
                return parameters[:2] + bytes((ENCRYPTION_KEY_SIZE,))
            case Op.REMOTE_NAME_CANCEL:
                return parameters[:6]
        return None

    def _of_link(self, op: int, parameters: bytes) -> tuple[int, bytes] | None:
        """The event that ends a command which asks the other side of a link something that we know."""
        handle = parameters[:2]
        match op:
            case Op.READ_REMOTE_FEATURES:
                return Ev.REMOTE_FEATURES_COMPLETE, b"\0" + handle + FEATURES
            case Op.READ_REMOTE_EXTENDED_FEATURES:
                link = self.links.get(int.from_bytes(handle, "little"))
                peer = self._air.find(link.peer(self.address)) if link else None
                host = bytes((peer.simple_pairing if peer else 0,)) + bytes(7)
                page = parameters[2]
                return Ev.REMOTE_EXTENDED_FEATURES_COMPLETE, b"\0" + handle + bytes((page, 1)) + (
                    host if page else FEATURES
                )
            case Op.READ_REMOTE_VERSION:
                return Ev.REMOTE_VERSION_COMPLETE, b"\0" + handle + struct.pack("<BHH", VERSION, COMPANY, 0)
            case Op.CHANGE_PACKET_TYPE:
                return Ev.PACKET_TYPE_CHANGED, b"\0" + parameters[:4]
        return None

    def _write(self, op: int, parameters: bytes) -> None:
        match op:
            case Op.WRITE_NAME:
                self.name = parameters
            case Op.WRITE_SCAN:
                self.scan = parameters[0]
                self._listen()
            case Op.WRITE_PAGE_SCAN_ACTIVITY:
                self._page_scans = parameters
                self._listen()
            case Op.WRITE_PAGE_SCAN_TYPE:
                self._page_scan_type = parameters[0]
                self._listen()
            case Op.WRITE_CLASS:
                self.device_class = parameters[:3]
            case Op.WRITE_SIMPLE_PAIRING:
                self.simple_pairing = parameters[0]
            case Op.WRITE_PAGE_TIMEOUT:
                self.page_timeout = int.from_bytes(parameters[:2], "little") * SLOT
        self._complete(op)

    def switch_off(self) -> None:
        """Links, pages, inquiries and settings are gone."""
        self._inquiry_number += 1
        self.calls.forget()
        self._air.forget(self)
        self._set_defaults()

    def _reset(self, op: int, parameters: bytes) -> None:
        self.switch_off()
        self._complete(op)

    # -- who is there ----------------------------------------------------------------------------------------

    def _inquiry(self, op: int, parameters: bytes) -> None:
        self._status(op)
        self._inquiry_number += 1
        number = self._inquiry_number

        def found() -> None:
            for other in self._air.others(self) if number == self._inquiry_number else ():
                if other.scan & INQUIRY_SCAN:
                    body = b"\x01" + hci.to_wire(other.address) + b"\x01\0" + other.device_class + b"\0\0"
                    self._event(Ev.INQUIRY_RESULT_RSSI, body + struct.pack("b", RSSI))

        def over() -> None:
            if number == self._inquiry_number:
                self._event(Ev.INQUIRY_COMPLETE, b"\0")

        seconds = parameters[3] * INQUIRY_UNIT
        self._air.after(seconds / 2, found)
        self._air.after(seconds, over)

    def _inquiry_cancel(self, op: int, parameters: bytes) -> None:
        self._inquiry_number += 1
        self._complete(op)

    def _remote_name(self, op: int, parameters: bytes) -> None:
        self._status(op)
        wire = parameters[:6]
        other = self._air.find(hci.from_wire(wire))
        # A link carries the question (LMP_name_req). Without one the other is paged, which it hears while it scans.
        asked = self.link_to(hci.from_wire(wire)) is not None or (other is not None and other.scan & PAGE_SCAN)
        if other in self._air.others(self) and asked:
            body = b"\0" + wire + other.name
            self._air.after(NAME_TIME, lambda: self._event(Ev.REMOTE_NAME_COMPLETE, body))
        else:
            body = bytes((Status.PAGE_TIMEOUT,)) + wire + bytes(248)
            self._air.after(self.page_timeout, lambda: self._event(Ev.REMOTE_NAME_COMPLETE, body))

    # -- links -----------------------------------------------------------------------------------------------

    def _disconnect(self, op: int, parameters: bytes) -> None:
        handle, reason = struct.unpack("<HB", parameters[:3])
        link = self.links.get(handle)
        if link is None:
            self._status(op, Status.UNKNOWN_CONNECTION)
            return
        self._status(op)
        self._air.disconnect(self, link, reason)

    def _switch_role(self, op: int, parameters: bytes) -> None:
        link = self.link_to(hci.from_wire(parameters[:6]))
        if link is None:
            self._status(op, Status.UNKNOWN_CONNECTION)
            return
        self._status(op)
        self._air.switch_roles(link, self.address, link.peer(self.address) if parameters[6] else self.address)

    def _tell_role(self, op: int, parameters: bytes) -> None:
        self._tell_of(op, parameters, lambda link: bytes((link.central != self.address,)))

    def _tell_rssi(self, op: int, parameters: bytes) -> None:
        self._tell_of(op, parameters, lambda link: struct.pack("b", self._air.medium.rssi))

    def _tell_of(self, op: int, parameters: bytes, what: Callable[[Link], bytes]) -> None:
        """Answer a command about a link that begins with its handle."""
        link = self.links.get(int.from_bytes(parameters[:2], "little"))
        code = Status.UNKNOWN_CONNECTION if link is None else Status.SUCCESS
        self._complete(op, bytes((code,)) + parameters[:2] + (b"\0" if link is None else what(link)))

    def _supervise(self, op: int, parameters: bytes) -> None:
        handle, slots = struct.unpack("<HH", parameters)
        link = self.links.get(handle)
        if link is None:
            code = Status.UNKNOWN_CONNECTION
        elif link.central != self.address:
            code = Status.COMMAND_DISALLOWED
        else:
            code, link.supervision = Status.SUCCESS, slots * SLOT
            self._air.supervise(link)
        self._complete(op, bytes((code,)) + parameters[:2])

    # -- security --------------------------------------------------------------------------------------------

    def _authenticate(self, op: int, parameters: bytes) -> None:
        link = self.links.get(int.from_bytes(parameters[:2], "little"))
        peer = self._air.find(link.peer(self.address)) if link is not None else None
        if link is None or peer is None:
            self._status(op, Status.UNKNOWN_CONNECTION)
            return
        self._status(op)
        link.wanting.append(self.address)
        self._begin_pairing(link)

    def _begin_pairing(self, link: Link) -> None:
        """Begin the next authentication of a link. Where both hosts ask at once, the link managers have one wait for
        the other, and each host hears how its own ended."""
        if not link.wanting or (link.pairing is not None and link.pairing.status is None):
            return
        initiator = link.wanting.popleft()
        ends = self._air.find(initiator), self._air.find(link.peer(initiator))
        simple = all(each is not None and each.simple_pairing for each in ends)
        link.pairing = Pairing(initiator, link.peer(initiator), simple, self._air.new_key)
        link.pairing.start()
        self._tell(link, link.pairing)

    def _pairing(self, op: int, parameters: bytes) -> None:
        self._complete(op, b"\0" + parameters[:6])
        link = self.link_to(hci.from_wire(parameters[:6]))
        if link is not None and link.pairing is not None and link.pairing.status is None:
            link.pairing.reply(self.address, op, parameters[6:])
            self._tell(link, link.pairing)

    def _tell(self, link: Link, pairing: Pairing) -> None:
        for address, packet in pairing.events():
            if address not in link.gone:
                self._air.send(address, packet)
        link.authenticated |= pairing.status == Status.SUCCESS
        if pairing.status is not None and pairing.initiator not in link.gone:
            body = struct.pack("<BH", pairing.status, link.ends[pairing.initiator])
            self._air.send(pairing.initiator, hci.event(Ev.AUTHENTICATION_COMPLETE, body))
        self._begin_pairing(link)

    def _encrypt(self, op: int, parameters: bytes) -> None:
        link = self.links.get(int.from_bytes(parameters[:2], "little"))
        if link is None:
            self._status(op, Status.UNKNOWN_CONNECTION)
            return
        self._status(op)
        on = parameters[2]
        if on and not link.authenticated:
            self._event(Ev.ENCRYPTION_CHANGE, bytes((Status.KEY_MISSING,)) + parameters[:2] + b"\0")
            return
        link.encrypted = bool(on)
        self._air.counts["encrypted"] += on
        for address, handle in link.ends.items():
            if address not in link.gone:
                self._air.send(
                    address, hci.event(Ev.ENCRYPTION_CHANGE, struct.pack("<BHB", Status.SUCCESS, handle, on))
                )
