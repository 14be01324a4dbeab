"""Logging to stderr; where that is the journal, with the priority prefixes of sd-daemon(3) for the levels.

Messages are a sentence followed by `key=value` pairs. Level by SWARM_LOG (debug, info, warning, error).

A message is one line of printable characters, whatever is in it: reasons and names come from other robots. The lines of
a traceback follow it, each marked, so that none of them looks like a message.
"""

import logging
import os
import sys

from swarm.process.terminal import guard
from swarm.process.text import printable

MAX_LINE = 2000
"""Characters of a line."""

MAX_TRACEBACK = 200
"""Lines of a traceback; the last ones say what has happened."""

TRACEBACK = "| "
"""Before each line of a traceback."""

_PRIORITY = {logging.DEBUG: 7, logging.INFO: 6, logging.WARNING: 4, logging.ERROR: 3, logging.CRITICAL: 2}


class _Formatter(logging.Formatter):
    def __init__(self, *, journal: bool) -> None:
        super().__init__("%(name)s: %(message)s" if journal else "%(asctime)s %(levelname)-7s %(name)s: %(message)s")
        self._journal = journal

    def format(self, record: logging.LogRecord) -> str:
        record.message = record.getMessage()
        if self.usesTime():
            record.asctime = self.formatTime(record, self.datefmt)
        lines = [printable(self.formatMessage(record), MAX_LINE)]
        if record.exc_info:
            more = self.formatException(record.exc_info).splitlines()[-MAX_TRACEBACK:]
            lines += [TRACEBACK + printable(line, MAX_LINE) for line in more]
        # Each line needs the prefix, or journald takes it for level info.
        prefix = f"<{_PRIORITY.get(record.levelno, 6)}>" if self._journal else ""
        return "\n".join(prefix + line for line in lines)


def setup(name: str) -> logging.Logger:
    """Configure the process' logging once and return the logger `name`."""
    guard()
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(_Formatter(journal=_is_journal()))
    logging.raiseExceptions = False  # a stderr that went away must not end in a traceback on it
    level = os.environ.get("SWARM_LOG", "info").upper()
    root = logging.getLogger()
    root.handlers[:] = [handler]
    root.setLevel(level if level in logging.getLevelNamesMapping() else "INFO")
    logging.getLogger("matplotlib").setLevel("WARNING")  # a user's first picture would begin with a line about fonts
    return logging.getLogger(name)


def _is_journal() -> bool:
    """Return whether stderr is the journal, as systemd names it; a child may inherit the name but not the pipe."""
    try:
        stream = os.fstat(sys.stderr.fileno())
    except (OSError, ValueError):
        return False
    return os.environ.get("JOURNAL_STREAM") == f"{stream.st_dev}:{stream.st_ino}"
