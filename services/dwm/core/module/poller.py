"""Asking the module for its location again and again, and what else others want of it: one request at a time.

Pure: the shell sends `to_send()`, feeds `receive()` and calls `handle_timer()` at `next_deadline()`.
"""

from collections import Counter, deque

from services.dwm.core.module import calls, shell
from services.dwm.core.module.exchange import RESTART, SLOW_TIMEOUT, TIMEOUT, Answer, ModuleExchange, Trouble
from services.dwm.core.module.tlv import LOC_GET, Location, ModuleCall
from swarm.errors import FrameError
from swarm.frozen import frozen

MAX_RATE = 10.0
"""The most requests a second: the module measures no faster, and faster requests would repeat the same data."""

FAILURES = 3
"""Requests in a row without a proper answer until the module counts as not working."""

MAX_PAUSE = 2.0
"""Longest pause between requests to a module that does not work, s."""

MAX_WAITING = 8
"""The most requests of other programs that wait for the line."""

_LEAVE = ModuleCall("leave the shell", shell.LEAVE, (), lambda _: None)
"""Bytes for a module that gives no answers. A module in shell mode leaves it, and any other answers that this is no
call."""


@frozen
class ModuleReport:
    """The module's answer."""

    location: Location
    age: float = 0.0
    """Seconds since the answer was given; above zero if another program had asked for it."""


@frozen
class ModuleHealth:
    """The module began to work, or ceased to; told on change only."""

    working: bool
    reason: str
    """What is wrong; empty where it works."""


@frozen
class Answered:
    """The result of another process's request."""

    ticket: str
    answer: bytes
    """The answer as it came from the module."""
    problem: str
    """Why there is no proper answer; empty where there is one, which may be a refusal."""


class Poller:
    """Requests at a fixed rate; `counters` tell what went wrong so far."""

    def __init__(self, rate: float, now: float) -> None:
        self.counters: Counter[str] = Counter()
        self._period = 1.0 / min(rate, MAX_RATE)
        self._pause = self._period
        self._due = now
        self._exchange: ModuleExchange[object] | None = None
        self._answer_by = 0.0
        self._away_until = now
        self._ticket: str | None = None
        self._waiting: deque[tuple[str, ModuleCall[object]]] = deque()
        self._out = bytearray()
        self._events: list[ModuleReport | ModuleHealth | Answered] = []
        self._failures = 0
        self._leaving = 0
        """How many times `quit` will still be sent to leave the shell."""
        self._trouble: str | None = None  # kind of the trouble last told; None before anything was

    def next_deadline(self) -> float:
        """Return the time at which to call `handle_timer` next."""
        if self._exchange is not None:
            return self._answer_by
        return min(self._due, self._away_until) if self._waiting else self._due

    def ask(self, ticket: str, request: bytes) -> None:
        """Queue another process's request as the next one. `Answered` follows in any case."""
        try:
            call = calls.call_of(request)
        except FrameError as error:
            self._events.append(Answered(ticket, b"", str(error)))
            return
        if len(self._waiting) >= MAX_WAITING:
            self._events.append(Answered(ticket, b"", "too many requests wait for the module, ask again"))
            return
        self._waiting.append((ticket, call))

    def handle_timer(self, now: float) -> None:
        """Give up on an answer that is late, send the next request when it is due."""
        if self._exchange is not None and now >= self._answer_by:
            self._finish(self._exchange, self._exchange.expire(), now)
        if self._exchange is None and now >= self.next_deadline():
            self._request(now)

    def receive(self, data: bytes, now: float) -> None:
        """Take bytes from the line; what comes unasked (a late answer) is dropped."""
        exchange = self._exchange
        if exchange is None:
            self.counters["unasked"] += 1
            return
        before = exchange.wrong_frames
        outcome = exchange.receive(data)
        if exchange.wrong_frames > before:
            self.counters["wrong_frames"] += exchange.wrong_frames - before
        if outcome is not None:
            self._finish(exchange, outcome, now)

    def to_send(self) -> bytes:
        """Return the bytes for the line, to be written in one piece: a gap of 763 us ends a request."""
        data = bytes(self._out)
        self._out.clear()
        return data

    def events(self) -> list[ModuleReport | ModuleHealth | Answered]:
        """Return the events since the last call, in order."""
        events, self._events = self._events, []
        return events

    def _request(self, now: float) -> None:
        call: ModuleCall[object]
        if self._waiting:
            self._ticket, call = self._waiting.popleft()
            self._answer_by = now + SLOW_TIMEOUT
        else:
            if self._failures > 0 and self._failures % FAILURES == 0 and not self._leaving:
                self._leaving = shell.LEAVE_TIMES
            self._ticket, call = None, _LEAVE if self._leaving else LOC_GET
            self._answer_by = now + TIMEOUT
            self._due += self._pause
            if self._due <= now:  # we were late: keep the distance instead of catching up
                self._due = now + self._pause
        self._exchange = ModuleExchange(call)
        self._out += call.request

    def _finish(self, exchange: ModuleExchange[object], outcome: Answer[object] | Trouble, now: float) -> None:
        self._exchange = None
        if self._ticket is not None:
            self._answered(exchange, outcome, now)
        elif isinstance(outcome, Trouble):
            self._failed(now, outcome, asked=exchange.call)
        elif isinstance(outcome.result, Location):
            self._worked(outcome.result)
        else:
            self._failures, self._leaving = self._failures + 1, 0  # a late answer, taken for that to `_LEAVE`

    def _answered(self, exchange: ModuleExchange[object], outcome: Answer[object] | Trouble, now: float) -> None:
        assert self._ticket is not None
        problem = outcome.reason if isinstance(outcome, Trouble) and outcome.kind != "refused" else ""
        self._events.append(Answered(self._ticket, outcome.raw, problem))
        self._ticket = None
        if exchange.call.request == calls.RESET.request and isinstance(outcome, Answer):
            self._due = self._away_until = now + RESTART

    def _worked(self, location: Location) -> None:
        if self._trouble != "":
            self._events.append(ModuleHealth(True, ""))
        self._trouble, self._failures, self._pause = "", 0, self._period
        self._events.append(ModuleReport(location))

    def _failed(self, now: float, trouble: Trouble, asked: ModuleCall[object]) -> None:
        if asked is _LEAVE:
            # Only a module in its shell has to be told again.
            self._leaving = self._leaving - 1 if trouble.kind == "shell" else 0
        if not self._leaving:
            self._failures += 1
        if not (asked is _LEAVE and trouble.kind == "refused"):  # so says a module that is not in its shell
            self.counters[trouble.kind] += 1
            self._tell(trouble)
        if self._failures >= FAILURES:
            self._pause = min(self._pause * 2, MAX_PAUSE)
            self._due = now + self._pause

    def _tell(self, trouble: Trouble) -> None:
        kind = trouble.reason if trouble.kind == "refused" else trouble.kind
        if self._failures >= FAILURES and kind != self._trouble:
            self._trouble = kind
            self._events.append(ModuleHealth(False, trouble.reason))
