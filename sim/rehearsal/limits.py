"""The time that an author's code may take while it is examined, and what ends it then."""

import signal
import time
from collections.abc import Callable
from types import FrameType
from typing import TypeVar

T = TypeVar("T")

STEP_LIMIT = 2.0
"""Seconds of computing after which a step hangs. The longest of ours takes some ms. Of CPU time, since what else the
machine does is no fault of the app."""

TIME_LIMIT = 8.0
"""Seconds of CPU time that one graph may take; what has been done by then is judged."""

WAIT_LIMIT = 20.0
"""Seconds by the clock after which a step hangs, and a graph ends, that waits for something instead of computing."""

ALARMS = (signal.SIGPROF, signal.SIGALRM)
"""What ends a step: it has computed, or waited, for too long."""


class Hang(BaseException):
    """A step took too long. No `Exception`: an author's own `except` must not swallow it."""

    def __init__(self, line: int, why: str) -> None:
        super().__init__(line, why)
        self.line, self.why = line, why


def limited(source: str, act: Callable[[], T]) -> T:
    """Do it, but not for ever: `Hang` names the line of `source` that it was at."""
    alarm.source = source  # type: ignore[attr-defined]
    signal.setitimer(signal.ITIMER_PROF, STEP_LIMIT)
    signal.setitimer(signal.ITIMER_REAL, WAIT_LIMIT)
    try:
        return act()
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        signal.setitimer(signal.ITIMER_REAL, 0.0)


def may_go_on() -> Callable[[], bool]:
    """Tells whether a graph that begins now may go on."""
    computed, waited = time.process_time() + TIME_LIMIT, time.monotonic() + WAIT_LIMIT
    return lambda: time.process_time() < computed and time.monotonic() < waited


def alarm(number: int, frame: FrameType | None) -> None:
    """Handle one of `ALARMS`: raise `Hang` with the line of the source that runs."""
    line = 1
    while frame is not None:
        if frame.f_code.co_filename == alarm.source:  # type: ignore[attr-defined]
            line = frame.f_lineno
            break
        frame = frame.f_back
    computed = f"computed for more than {STEP_LIMIT:g} s"
    raise Hang(line, computed if number == signal.SIGPROF else f"took more than {WAIT_LIMIT:g} s")
