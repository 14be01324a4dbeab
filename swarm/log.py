"""Logging to stderr with the priority prefixes of sd-daemon(3), so that journald keeps the levels.

Messages are a sentence followed by `key=value` pairs. Level by the variable SWARM_LOG (debug, info, warning, error).
"""

import logging
import os
import sys

_PRIORITY = {logging.DEBUG: 7, logging.INFO: 6, logging.WARNING: 4, logging.ERROR: 3, logging.CRITICAL: 2}


class _JournalFormatter(logging.Formatter):
    def format(self, record: logging.LogRecord) -> str:
        text = super().format(record)
        # A multi-line record needs the prefix on each line, or journald splits it into unlabelled ones.
        prefix = f"<{_PRIORITY.get(record.levelno, 6)}>" if self._journal else ""
        return "\n".join(prefix + line for line in text.splitlines())

    def __init__(self, journal: bool) -> None:
        super().__init__("%(name)s: %(message)s" if journal else "%(asctime)s %(levelname)-7s %(name)s: %(message)s")
        self._journal = journal


def setup(name: str) -> logging.Logger:
    """Configure the process' logging once and return the logger `name`."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(_JournalFormatter(journal="JOURNAL_STREAM" in os.environ))
    level = os.environ.get("SWARM_LOG", "info").upper()
    root = logging.getLogger()
    root.handlers[:] = [handler]
    root.setLevel(level if level in logging.getLevelNamesMapping() else "INFO")
    return logging.getLogger(name)
