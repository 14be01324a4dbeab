"""A robot's journal on the laptop: a text file that grows, and beside it where it ends in the robot's journal.

The robot's journald gives each entry a cursor. The mark holds the cursor of the last entry that was kept and the size
of the text then, so that a transfer which broke goes on behind it, with nothing twice and nothing missing.
"""

from datetime import UTC, datetime

from swarm.errors import PayloadError
from swarm.frozen import frozen
from swarm.messages.json_input import read_json
from swarm.process.text import printable

FIELDS = "MESSAGE,_SYSTEMD_UNIT,UNIT,PRIORITY,_PID,SYSLOG_IDENTIFIER"
_LEVELS = ("emergency", "alert", "critical", "error", "warning", "notice", "info", "debug")
_MAX_DIGITS = 20
"""The most digits of a size in a mark: Python converts no text of more than 4300 digits."""


@frozen
class JournalMark:
    """The place up to which a journal was fetched."""

    size: int = 0
    """Bytes of text."""
    cursor: str = ""

    @property
    def text(self) -> str:
        """Return the mark as text to keep."""
        return f"{self.size} {self.cursor}\n"

    @classmethod
    def of(cls, text: str) -> "JournalMark":
        """Read a mark that was kept. One that cannot be read stands for the beginning of the journal."""
        size, _, cursor = text.strip().partition(" ")
        if not text.endswith("\n"):
            return cls()
        known = size.isascii() and size.isdecimal() and len(size) <= _MAX_DIGITS and cursor
        return cls(int(size), cursor) if known else cls()


def entry(line: str) -> tuple[str, str] | None:
    """Parse an entry of `journalctl --output=json` into (cursor, line of text); None where it is no entry."""
    try:
        fields = read_json(line)
        cursor, micros = fields["__CURSOR"], int(fields["__REALTIME_TIMESTAMP"])
        moment = datetime.fromtimestamp(micros / 1e6, UTC)
    except (PayloadError, ValueError, LookupError, TypeError, OverflowError, OSError):
        return None
    unit = str(fields.get("UNIT") or fields.get("_SYSTEMD_UNIT") or fields.get("SYSLOG_IDENTIFIER") or "?")
    priority = str(fields.get("PRIORITY", ""))
    level = _LEVELS[int(priority)] if priority in tuple("01234567") else "info"
    who = f"{unit.removesuffix('.service')}[{fields.get('_PID', '-')}]"
    said = _message(fields.get("MESSAGE"))
    return printable(str(cursor), None), printable(f"{moment:%Y-%m-%dT%H:%M:%S.%fZ} {who} {level}: {said}", None)


def _message(value: object) -> str:
    """Return a message as text. journald gives one that is no text as a list of bytes, and leaves out one that is too
    long."""
    if isinstance(value, list):
        value = bytes(each for each in value if isinstance(each, int) and 0 <= each < 256).decode(errors="replace")
    return "(left out)" if value is None else str(value)
