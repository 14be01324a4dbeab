"""The way of an app's `print` and `self.robot.log` onto the robot's bus, into its recording and the robot's log.

`print` knows no robot: who has called it is found on the stack, so that nothing is done for an app that prints nothing.
"""

import contextlib
import io
import logging
import sys
from collections.abc import Callable, Iterator
from types import FrameType
from typing import Any, TextIO

from services.apps.runner import AppRunner
from swarm.app.robot import Robot
from swarm.bus.protocol import BusLike
from swarm.messages import AppLog
from swarm.messages.keys import key
from swarm.process.log import MAX_LINE
from swarm.process.text import printable

MOST_LINES_S = 100
"""Lines of one app and robot that are told in a second. The next line says that the others are left out."""

PRINTED = "print"
"""The level of printed text."""

Sink = Callable[[AppLog], None]

Said = Callable[[str, str], None]
"""A function that tells a text of a level."""


class Speaker:
    """Tells what one app on one robot says."""

    def __init__(self, robot: Robot, bus: BusLike, *sinks: Sink) -> None:
        """`sinks` get each line besides the bus."""
        self._robot = robot
        self._bus = bus
        self._sinks = sinks
        self._key = key(robot.name, f"app/{robot.app}", "log")
        self._second, self._count = -1, 0
        self._ended = False

    def __call__(self, level: str, text: str) -> None:
        """Tell a text: `debug`, `info`, `warning`, `error` or `print`."""
        if self._ended:
            return
        now = self._robot.now
        if int(now) != self._second:
            self._second, self._count = int(now), 0
        for line in text.splitlines():
            self._count += 1
            if self._count <= MOST_LINES_S:
                self._tell(AppLog(now, level, printable(line, MAX_LINE)))
            elif self._count == MOST_LINES_S + 1:  # at once: the app may end, and nothing comes after it
                text = f"more than {MOST_LINES_S} lines within a second: the others of this second are left out"
                self._tell(AppLog(now, "warning", text))

    def end(self) -> None:
        """Tell nothing any more, since the app's process was killed: what it had printed without an end of the line is
        lost with it."""
        self._ended = True

    def _tell(self, line: AppLog) -> None:
        self._bus.publish(self._key, line)
        for sink in self._sinks:
            sink(line)


def let_speak(robot: Robot, bus: BusLike, parent: logging.Logger | None, *sinks: Sink) -> Speaker:
    """Let an app be heard, and return what tells its lines. `parent`: the log of the process that runs it, which gets
    all lines, too."""
    speaker = Speaker(robot, bus, *sinks)
    # Not one of `getLogger`: under virtual time each robot has one, in one process and in run after run.
    log = logging.Logger(robot.app, min(logging.INFO, logging.getLogger().level))  # noqa: LOG001
    log.parent = parent
    log.addHandler(_Handler(speaker))
    robot.log, robot.said = log, speaker
    return speaker


@contextlib.contextmanager
def prints_heard(log: logging.Logger | None = None) -> Iterator[None]:
    """Take what apps print as lines of those apps, and write it to `log`, too. Other prints go to stdout. At the end of
    this the lines that have no end are told, too."""
    before = sys.stdout
    sys.stdout = printed = _Printed(before, log)
    try:
        yield
    finally:
        sys.stdout = before
        printed.end()


class _Handler(logging.Handler):
    def __init__(self, speaker: Speaker) -> None:
        super().__init__()
        self._speaker = speaker

    def emit(self, record: logging.LogRecord) -> None:
        try:
            text = record.getMessage()
        except (TypeError, ValueError) as error:  # logging itself does not end a program for a wrong format
            text = f"{record.msg} ({error})"
        self._speaker(record.levelname.lower(), text)


class _Printed(io.TextIOBase):
    """A replacement of stdout that passes on what an app prints."""

    def __init__(self, before: TextIO, log: logging.Logger | None) -> None:
        self._before = before
        self._log = log
        self._begun: dict[Said, str] = {}
        """Lines that are not at their end, by what tells them: one for each process of an app."""

    def write(self, text: str) -> int:
        robot = _speaking(sys._getframe(1))
        if robot is None or robot.said is None:
            return self._before.write(text)
        *lines, rest = (self._begun.pop(robot.said, "") + text).split("\n")
        if rest:
            self._begun[robot.said] = rest[-MAX_LINE:]
        for line in lines:
            self._tell(robot.said, line)
        return len(text)

    def end(self) -> None:
        """Tell the lines that are not at their end: nothing comes any more."""
        for said, line in self._begun.items():
            self._tell(said, line)

    def _tell(self, said: Said, line: str) -> None:
        said(PRINTED, line)
        if self._log is not None:
            self._log.info("%s", line)

    def flush(self) -> None:
        self._before.flush()

    def isatty(self) -> bool:
        return self._before.isatty()

    def fileno(self) -> int:
        return self._before.fileno()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._before, name)


def _speaking(frame: FrameType | None) -> Robot | None:
    """Return the robot whose app's code has called."""
    while frame is not None:
        if frame.f_code is AppRunner._call.__code__:
            found: Robot = frame.f_locals["self"].app.robot
            return found
        frame = frame.f_back
    return None
