"""The ATmega's end of the DWM1001's line, as firmware/module.cpp does it: polls, reports, and the mailbox.

Pure: whoever has the line sends `to_send()`, feeds `receive()` and calls `handle_timer()` often.
"""

import struct
from collections.abc import Callable

from services.balancer.core.devices import balboa
from services.balancer.core.devices.mailbox import MailboxState as Mail
from services.balancer.core.devices.uwb import UwbState
from services.dwm.core.module.tlv import LOC_GET, Location, TlvDecoder, encode_location
from swarm.errors import FrameError

SOURCE = "balancer"
"""`[dwm] source` of robots whose module hangs on the ATmega."""
TTY = "dwm.tty"
"""A simulated module's end of the line, a file in the robot's runtime directory."""

PERIOD = 0.100
PATIENCE = 0.090
SILENCE = 0.005
"""Seconds of silence after which an answer that was begun will not go on."""
MAILBOX_PATIENCE = 0.5
PAGES = 10
MAILBOX_SIZE = PAGES * balboa.WINDOW_SIZE
"""Bytes of the mailbox."""

_REPORT_HEAD = struct.Struct("<HH")
_HEAD, _PLACE, _RECORD = 21, slice(5, 18), 20
"""Where the answer to loc_get has its ranges and its place, and the bytes of a range."""


def module_address(index: int) -> str:
    """Return the short address of the module of the robot of this number, where the config gives none."""
    return f"{0xDE00 + index:04X}"


class ModuleLine:
    """The line as its module describes it. Times are those of the caller's clock."""

    def __init__(self, now: float) -> None:
        self.state = UwbState.SILENT
        self.error = 0
        self.bad = 0
        self.mail = Mail.EMPTY
        self.echo = 0
        self.answer_length = 0
        self.mailbox = bytearray(MAILBOX_SIZE)
        """The request; then the answer."""
        self.newest = 0
        """The sequence number of the newest report; 0 before there is one."""
        self._report = bytes(balboa.UWB_SIZE)
        self._came = now
        self._request_length = 0
        self._out = b""
        self._decoder = TlvDecoder(LOC_GET)
        self._line = ""
        """What is asked: "poll", "mail", or nothing."""
        self._since = self._last_poll = self._last_byte = now
        self._heard = False
        self._answer = bytearray()

    def post(self, token: int, length: int) -> None:
        """Send the first `length` bytes of the mailbox as soon as the line is free."""
        self.mail, self.echo, self.answer_length, self._request_length = Mail.BUSY, token, 0, length

    def reporting(self, now: float) -> Callable[[], bytes]:
        """Return a function that makes the UWB block as it is at this moment: few ask for it."""
        sequence, came, report = self.newest, self._came, self._report

        def block() -> bytes:
            age = min(0xFFFF, int((now - came) * 1e3)) if sequence else 0xFFFF
            return _REPORT_HEAD.pack(sequence, age) + report[_REPORT_HEAD.size :]

        return block

    def receive(self, data: bytes, now: float) -> None:
        """Take bytes from the module."""
        self._last_byte, self._heard = now, True
        if self._line == "mail":
            self._answer += data
        elif self._line == "poll":
            self._decoder.receive(data)
            self._read_location(now)

    def handle_timer(self, now: float) -> None:
        """Give up an answer that is late, and ask anew when it is time."""
        if self._line == "poll":
            if self._heard and now - self._last_byte >= SILENCE:
                self._decoder.reset()
            if now - self._since >= PATIENCE:
                self.bad = (self.bad + self._heard) % 256
                self.state, self._line = UwbState.BROKEN if self._heard else UwbState.SILENT, ""
        elif self._line == "mail":
            self._wait_for_answer(now)
        if self._line:
            return
        if self.mail == Mail.BUSY:
            self.state = UwbState.PAUSED
            self._ask("mail", bytes(self.mailbox[: self._request_length]), now)
        elif now - self._last_poll >= PERIOD:
            self._last_poll = now if now - self._last_poll >= 2 * PERIOD else self._last_poll + PERIOD
            self._ask("poll", LOC_GET.request, now)

    def to_send(self) -> bytes:
        """Return the bytes for the module."""
        data, self._out = self._out, b""
        return data

    def _ask(self, what: str, request: bytes, now: float) -> None:
        self._line, self._since, self._heard, self._out = what, now, False, request
        self._decoder.reset()
        self._answer.clear()

    def _read_location(self, now: float) -> None:
        while self._line:
            try:
                answer = self._decoder.next()
            except FrameError:
                continue
            if answer is None:
                return
            self._line = ""
            if isinstance(answer, Location):
                self.state = UwbState.OK
                self._publish(answer, now)
            else:
                self.state, self.error = UwbState.REFUSED, answer.code

    def _publish(self, location: Location, now: float) -> None:
        self.newest = self.newest % 0xFFFF + 1
        self._came = now
        data = encode_location(location)
        count = data[_HEAD - 1]
        records = [data[_HEAD + _RECORD * n :][:_RECORD] for n in range(min(count, balboa.UWB_RANGES))]
        ranges = b"".join(each[: balboa.UWB_RANGE_SIZE] for each in records)
        places = b"".join(each[balboa.UWB_RANGE_SIZE :] for each in records)
        self._report = b"".join(
            (
                bytes(4),
                bytes((count,)),
                data[_PLACE],
                ranges.ljust(balboa.UWB_RANGE_SIZE * balboa.UWB_RANGES, b"\0"),
                places.ljust(balboa.UWB_PLACE_SIZE * balboa.UWB_RANGES, b"\0"),
                struct.pack("<H", self.newest),
            )
        )

    def _wait_for_answer(self, now: float) -> None:
        if self._answer and now - self._last_byte >= SILENCE:
            self.mail = Mail.ANSWERED if _is_whole(self._answer) else Mail.BROKEN
            kept = self._answer[:MAILBOX_SIZE]
            self.mailbox[: len(kept)] = kept
            self.answer_length = len(kept)
        elif not self._answer and now - self._since >= MAILBOX_PATIENCE:
            self.mail = Mail.SILENT
        else:
            return
        self._line = ""


def _is_whole(answer: bytearray) -> bool:
    """Return whether an answer is whole: a status, and after one that is OK whole parts (firmware/tlv.cpp)."""
    if len(answer) < 3 or len(answer) > MAILBOX_SIZE or answer[:2] != b"\x40\x01":
        return False
    at = 3
    while at + 2 <= len(answer):
        at += 2 + answer[at + 1]
    return at == len(answer) and (answer[2] == 0 or at == 3)
