"""Every wait of the lab: it says what it waits for while it waits, and what it saw last when it gives up.

A line is printed to standard error after `FIRST_S` seconds and then every `AGAIN_S` seconds. `./run lab` lets pytest
pass standard error through, so a person or a log of CI sees within a minute what a slow test waits for. This module
needs only Python's standard library: it also runs inside machines.
"""

import os
import select
import subprocess
import time
from collections.abc import Callable, Sequence
from typing import Any, NoReturn, TypeVar

FIRST_S = 5.0
"""Seconds of waiting before the first line is printed."""

AGAIN_S = 15.0
"""Seconds between further lines."""

PATIENCE_S = 400.0
"""Default for the longest wait, in seconds. It only bounds a failure: a busy host makes everything slow."""

SHOWN = 400
"""Characters of the last state that a line has; a failure has all of it."""

T = TypeVar("T")


class WaitedInVainError(AssertionError):
    """What was waited for did not happen; the text has what it was and the state seen last."""


class Wait:
    """One wait, for a loop that has its own way of blocking: call `look` in each turn."""

    def __init__(self, what: str, seconds: float = PATIENCE_S, state: Callable[[], object] | None = None) -> None:
        """`what` describes the condition in words; `state()` returns what is so now, for the printed lines."""
        self._what = what
        self._seconds = seconds
        self._state = state
        self._began = time.monotonic()
        self._print_at = self._began + FIRST_S

    @property
    def elapsed(self) -> float:
        """Seconds since the wait began."""
        return time.monotonic() - self._began

    def look(self) -> float:
        """Print a line if one is due. Return the seconds for which the caller may block before it calls again; raise
        `WaitedInVainError` when the time is up."""
        now = time.monotonic()
        end = self._began + self._seconds
        if now >= end:
            self.fail(f"not within {self._seconds:g} s")
        if now >= self._print_at:
            self._print_at = now + AGAIN_S
            since = f"waiting since {now - self._began:.0f} s, at most {self._seconds:g} s"
            say(f"{since}: {self._what}{self._seen(SHOWN)}")
        return max(0.0, min(end, self._print_at) - now)

    def fail(self, why: str) -> NoReturn:
        """Give up: print and raise the same text."""
        text = f"{self._what}: {why}{self._seen(None)}"
        say(text)
        raise WaitedInVainError(text)

    def _seen(self, limit: int | None) -> str:
        if self._state is None:
            return ""
        seen = str(self._state())
        if limit is not None and len(seen) > limit:
            seen = "..." + seen[-limit:]
        return f"; seen last: {seen}"


def until(
    what: str,
    condition: Callable[[], T | None],
    seconds: float = PATIENCE_S,
    state: Callable[[], object] | None = None,
    every: float = 0.05,
) -> T:
    """Call `condition` every so many seconds until it returns something true, and return that."""
    wait = Wait(what, seconds, state)
    while not (found := condition()):
        time.sleep(min(every, wait.look()))
    return found


def readable(what: str, file: Any, seconds: float = PATIENCE_S) -> None:
    """Wait until a file, socket or descriptor can be read."""
    wait = Wait(what, seconds)
    while not select.select([file], [], [], wait.look())[0]:
        pass


def finished(what: str, process: "subprocess.Popen[str]", seconds: float = PATIENCE_S) -> tuple[str, str]:
    """Wait for a process to end; return its standard output and error."""
    wait = Wait(what, seconds)
    while True:
        try:
            return process.communicate(timeout=wait.look())
        except subprocess.TimeoutExpired:
            continue
        except WaitedInVainError:
            process.kill()
            process.communicate()
            raise


def run(what: str, words: Sequence[str], seconds: float = PATIENCE_S) -> str:
    """Run a command of the host; return its standard output. Its exit code must be 0."""
    process = subprocess.Popen(
        words, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    output, errors = finished(what, process, seconds)
    assert process.returncode == 0, f"{what}: exit code {process.returncode}: {output}{errors}"
    return output


def say(text: str) -> None:
    """Print a line to standard error at once, in one write, so that lines of several processes do not mix."""
    test = os.environ.get("PYTEST_CURRENT_TEST", "").rpartition(" (")[0].rpartition("/")[2]
    os.write(2, f"lab: {test + ': ' if test else ''}{text}\n".encode(errors="replace"))
