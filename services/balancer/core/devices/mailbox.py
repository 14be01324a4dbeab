"""Any request to the DWM1001 and its answer, through the ATmega's mailbox: one at a time, page by page.

    lay the request down, 28 bytes a page -> token and length -> wait -> read the answer, a page a transfer

Polling for locations pauses meanwhile (firmware/README.md, Mailbox).
"""

import enum

from services.balancer.core.devices import balboa
from services.balancer.core.slack.transfers import read, write
from services.balancer.core.slack.wire_time import WHOLE, Room, Transfer
from swarm.errors import LocalError, RemoteError
from swarm.messages import ModuleAnswer, ModuleRequest
from swarm.messages.devices import MODULE_CALLS

REQUEST_LIMITS = (2, 255)
"""Least and most bytes of a request: type and length, and a value of at most 253 bytes."""
TICKET_LIMIT = 64
"""The most characters of a ticket."""
PATIENCE_S = 3.0
"""Seconds from the request to the end of its answer; the ATmega needs 0.6 s for a module that is silent."""
WAIT_S = 0.02
"""Seconds between two looks for the answer."""
FAILURES = 40
"""Failed transfers in a row, 20 ms apart, after which a request is given up: longer than a mailbox can be busy with
what somebody asked before us, when it does not acknowledge."""

_STATE = read(balboa.MAILBOX_STATE, 4)


class MailboxState(enum.IntEnum):
    """The values of the register MAILBOX_STATE."""

    EMPTY = 0
    BUSY = 1
    ANSWERED = 2
    SILENT = 3
    BROKEN = 4


PROBLEMS = {
    MailboxState.EMPTY: "the ATmega was reset meanwhile",
    MailboxState.SILENT: "the module does not answer",
    MailboxState.BROKEN: "what came is no answer: is the module in shell mode?",
}


def check_request(request: ModuleRequest) -> None:
    """Raises `LocalError` where it cannot be sent, or is a call that a program on the bus may not make."""
    low, high = REQUEST_LIMITS
    data = request.request
    if not low <= len(data) <= high:
        raise LocalError(f"request of {len(data)} bytes, expected {low} to {high}")
    if len(data) != 2 + data[1]:
        raise LocalError(
            f"request of type {data[0]:02X} has a value of {len(data) - 2} bytes, its length says {data[1]}"
        )
    if MODULE_CALLS.get(data[0]) != data[1]:
        raise LocalError(f"request {data[:20].hex(' ')}: not one of the calls that are let through")
    if len(request.ticket) > TICKET_LIMIT:
        raise LocalError(f"ticket of {len(request.ticket)} characters, at most {TICKET_LIMIT}")


class Mailbox:
    """A slack task; `news` has the answer when there is one."""

    def __init__(self) -> None:
        self.news: ModuleAnswer | None = None
        """What is to be told; whoever takes it sets None."""
        self._request: ModuleRequest | None = None
        self._last: ModuleAnswer | None = None
        self._token = 0
        self._phase = ""
        self._at = 0
        """The index of the next byte of the request, or of the answer."""
        self._sent = 0
        """Bytes of the request in the last transfer."""
        self._give_up_at = self._look_at = 0.0
        self._failures = 0
        self._answer = bytearray()
        self._length = 0
        self._state = MailboxState.EMPTY

    @property
    def active(self) -> bool:
        """Whether a request is under way."""
        return self._request is not None

    def post(self, request: ModuleRequest, now: float) -> None:
        """Send a request that `check_request` accepted; while another one is under way it is refused by an answer."""
        if self._request is not None and request.ticket == self._request.ticket:
            return
        if self._last is not None and request.ticket == self._last.ticket:
            self.news = self._last
            return
        if self._request is not None:
            self.news = ModuleAnswer(now, request.ticket, b"", "another request is under way: wait for its answer")
            return
        self._request, self._phase, self._at = request, "lay", 0
        self._token = (self._token + 1) % 256
        self._give_up_at, self._look_at, self._failures = now + PATIENCE_S, now, 0

    def expire(self, now: float) -> None:
        """Give up a request whose time is over; `next` does that too, where it is called."""
        if self._request is not None and now >= self._give_up_at:
            self._end(now, f"no answer within {PATIENCE_S:g} s")

    def next(self, now: float, room: Room = WHOLE) -> Transfer | None:
        self.expire(now)
        request = self._request
        if request is None or now < self._look_at:
            return None
        if self._phase == "lay":
            page, offset = divmod(self._at, balboa.WINDOW_SIZE)
            self._sent = max(1, min(balboa.WINDOW_SIZE - offset, room.write - (offset == 0)))
            part = request.request[self._at : self._at + self._sent]
            if offset:  # the page stays the one of the write before
                return write(balboa.MAILBOX_WINDOW + offset, part)
            return write(balboa.MAILBOX_PAGE, bytes((page,)) + part)
        if self._phase == "go":
            return write(balboa.MAILBOX_TOKEN, bytes((self._token, len(request.request))))
        if self._phase == "wait":
            return _STATE
        page, offset = divmod(self._at, balboa.WINDOW_SIZE)
        count = max(1, min(balboa.WINDOW_SIZE - offset, room.read - (2 if offset == 0 else 0)))
        if offset:
            return read(balboa.MAILBOX_WINDOW + offset, count)
        # The index stays where the write began: page and window come back in one.
        return Transfer(balboa.ADDRESS, bytes((balboa.MAILBOX_PAGE, page)), 1 + count)

    def take(self, data: bytes, now: float) -> None:
        assert self._request is not None
        self._failures = 0
        if self._phase == "lay":
            self._at += self._sent
            if self._at >= len(self._request.request):
                self._phase = "go"
        elif self._phase == "go":
            self._phase, self._look_at = "wait", now + WAIT_S
        elif self._phase == "wait":
            self._waited(data, now)
        else:
            self._read(data, now)

    def fail(self, error: OSError, now: float) -> None:
        self._failures += 1
        self._look_at = now + WAIT_S
        if self._failures >= FAILURES and self._request is not None:
            self._end(now, f"I2C: {error.strerror or error}")

    def _waited(self, data: bytes, now: float) -> None:
        self._look_at = now + WAIT_S
        try:
            self._state = MailboxState(data[0])
        except ValueError:
            raise RemoteError(f"ATmega: MAILBOX_STATE is {data[0]}, there is none") from None
        if self._state == MailboxState.BUSY:
            return
        if data[1] != self._token and self._state != MailboxState.EMPTY:
            self._end(now, "another answer is in the mailbox: does somebody else use the ATmega?")
            return
        self._length = min(int.from_bytes(data[2:], "little"), 10 * balboa.WINDOW_SIZE)
        self._answer.clear()
        self._phase, self._at = "read", 0
        if self._length == 0:
            self._end(now, PROBLEMS.get(self._state, ""))

    def _read(self, data: bytes, now: float) -> None:
        page, offset = divmod(self._at, balboa.WINDOW_SIZE)
        if offset == 0:
            if data[0] != page:
                raise RemoteError(f"ATmega: page {data[0]} of the mailbox instead of {page}")
            data = data[1:]
        self._answer += data
        self._at += len(data)
        if len(self._answer) >= self._length:
            del self._answer[self._length :]
            self._end(now, PROBLEMS.get(self._state, ""))

    def _end(self, now: float, problem: str) -> None:
        assert self._request is not None
        answer = bytes(self._answer) if self._phase == "read" else b""
        self._last = self.news = ModuleAnswer(now, self._request.ticket, answer, problem)
        self._request = None
