"""The time that an author's code may take while it is examined, and what ends it then."""

import resource
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

_THIS_THREAD = getattr(resource, "RUSAGE_THREAD", resource.RUSAGE_SELF)
"""Whose pauses are counted; macOS counts those of the whole process only."""

ALARMS = (signal.SIGPROF, signal.SIGALRM)
"""Signals that end a step: it has computed, or waited, for too long."""


class Hang(BaseException):
    """A step took too long. No `Exception`: an author's own `except` must not swallow it."""

    def __init__(self, line: int, why: str) -> None:
        super().__init__(line, why)
        self.line, self.why = line, why


def limited(source: str, act: Callable[[], T]) -> T:
    """Call `act` and return its result. Raises `Hang` with the line of `source` that runs when the time is over."""
    alarm.source = source  # type: ignore[attr-defined]
    signal.setitimer(signal.ITIMER_PROF, STEP_LIMIT)
    signal.setitimer(signal.ITIMER_REAL, WAIT_LIMIT)
    try:
        return act()
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        signal.setitimer(signal.ITIMER_REAL, 0.0)


class Stopwatch:
    """Measures time from when it is made."""

    def __init__(self) -> None:
        self._clock, self._computed, self._pauses = time.monotonic(), time.process_time(), _pauses()

    @property
    def computed(self) -> float:
        """Return the seconds of CPU time."""
        return time.process_time() - self._computed

    @property
    def waited(self) -> float:
        """Return the seconds without computing; 0 if this thread has not waited by itself. Then other programs have had
        the processor, which is no fault of the app."""
        return time.monotonic() - self._clock - self.computed if _pauses() > self._pauses else 0.0

    @property
    def spent(self) -> str:
        """Return the limit of a graph that is exceeded, in words; empty for none."""
        if self.computed >= TIME_LIMIT:
            return f"{TIME_LIMIT:g} s of computing"
        return f"{WAIT_LIMIT:g} s by the clock" if time.monotonic() - self._clock >= WAIT_LIMIT else ""


class Waits:
    """The robots whose last step waited for longer than its period."""

    def __init__(self) -> None:
        self._robots: set[str] = set()

    def judge(self, robot: str, waited: float, period: float | None) -> str:
        """Take how long a robot's step has waited, s. Return what is wrong if it and the step before it both waited for
        longer than the period; otherwise an empty text."""
        if period is None or waited <= period:
            self._robots.discard(robot)
            return ""
        again = robot in self._robots
        self._robots.add(robot)
        return f"a step waits longer than its period of {period:g} s (for {waited:.2g} s)" if again else ""


def _pauses() -> int:
    return resource.getrusage(_THIS_THREAD).ru_nvcsw


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
