"""Asking the module for its location again and again: one request at a time, and what to think of silence.

Pure: the shell sends `to_send()`, feeds `receive()` and calls `handle_timer()` at `next_deadline()`.
"""

from collections import Counter
from dataclasses import dataclass

from services.dwm.core.tlv import LOC_GET, Decoder, Location, Refusal
from swarm.errors import FrameError

TIMEOUT = 0.100
"""s to wait for an answer (API guide: one request at a time; the module answers within 100 ms)."""

MAX_RATE = 10.0
"""Hz: the module measures at most that often, asking faster repeats the same data."""

FAILURES = 3
"""Requests in a row without a proper answer until the module counts as not working."""

MAX_PAUSE = 2.0
"""s: longest pause between requests to a module that does not work."""


@dataclass(frozen=True, slots=True)
class Report:
    """The module's answer."""

    location: Location


@dataclass(frozen=True, slots=True)
class Health:
    """The module began to work, or ceased to; told on change only."""

    working: bool
    reason: str
    """What is wrong; empty where it works."""


class Poller:
    """Requests at a fixed rate; `counters` tell what went wrong so far."""

    def __init__(self, rate: float, now: float) -> None:
        self.counters: Counter[str] = Counter()
        self._period = 1.0 / min(rate, MAX_RATE)
        self._pause = self._period
        self._due = now
        self._answer_by: float | None = None
        self._decoder = Decoder(LOC_GET)
        self._out = bytearray()
        self._events: list[Report | Health] = []
        self._failures = 0
        self._trouble: str | None = None  # kind of the trouble last told; None before anything was
        self._garbled = ""
        self._skipped = 0

    def next_deadline(self) -> float:
        """When to call `handle_timer` next."""
        return self._due if self._answer_by is None else self._answer_by

    def handle_timer(self, now: float) -> None:
        """Give up on an answer that is late, send the next request when it is due."""
        if self._answer_by is not None and now >= self._answer_by:
            self._answer_by = None
            if self._garbled or self._decoder.skipped + self._pending() > self._skipped:
                self.counters["garbled"] += 1
                hint = f" ({self._garbled})" if self._garbled else ""
                self._failed(now, "garbled", f"its answers are garbled{hint}: wrong baud rate, or shell mode?")
            else:
                self.counters["silent"] += 1
                self._failed(now, "silent", "it does not answer: is it wired, powered and in generic mode?")
        if self._answer_by is None and now >= self._due:
            self._request(now)

    def receive(self, data: bytes, now: float) -> None:
        """Take bytes from the line; what comes unasked (a late answer) is dropped."""
        if self._answer_by is None:
            self.counters["unasked"] += 1
            return
        self._decoder.receive(data)
        while self._answer_by is not None:
            try:
                answer = self._decoder.next()
            except FrameError as error:
                self.counters["wrong_frames"] += 1
                self._garbled = str(error)
                continue
            if answer is None:
                return
            self._answer_by = None
            if isinstance(answer, Refusal):
                self.counters["refused"] += 1
                self._failed(now, f"refused {answer.code}", f"it refuses loc_get: {answer.name}")
            else:
                self._worked(answer)

    def to_send(self) -> bytes:
        """Bytes for the line, to be written in one piece: a gap of 763 us ends a request."""
        data = bytes(self._out)
        self._out.clear()
        return data

    def events(self) -> list[Report | Health]:
        """What happened since the last call, in order."""
        events, self._events = self._events, []
        return events

    def _request(self, now: float) -> None:
        self._decoder.reset()
        self._skipped, self._garbled = self._decoder.skipped, ""
        self._out += LOC_GET.request
        self._answer_by = now + TIMEOUT
        self._due += self._pause
        if self._due <= now:  # we were late: keep the distance instead of catching up
            self._due = now + self._pause

    def _pending(self) -> int:
        """Bytes of an answer that never got whole."""
        before = self._decoder.skipped
        self._decoder.reset()
        return self._decoder.skipped - before

    def _worked(self, location: Location) -> None:
        if self._trouble != "":
            self._events.append(Health(True, ""))
        self._trouble, self._failures, self._pause = "", 0, self._period
        self._events.append(Report(location))

    def _failed(self, now: float, kind: str, reason: str) -> None:
        self._failures += 1
        if self._failures < FAILURES:
            return
        if kind != self._trouble:
            self._trouble = kind
            self._events.append(Health(False, reason))
        self._pause = min(self._pause * 2, MAX_PAUSE)
        self._due = now + self._pause
