"""The display, an SSD1306 of 128 x 64 points: text as columns, and only what changed as slices (datasheet 8, 9).

Its memory is 8 pages of 128 columns; a byte is a column of a page. Columns that changed are sent up to 26 at a time,
2.5 ms at 100 kHz, or as many as fit where there is less time. A full picture is 48 transfers; a changed word two.
"""

from collections.abc import Sequence

from services.balancer.core.devices.font import LETTERS, UNKNOWN, WIDTH
from services.balancer.core.slack.wire_time import LONGEST, WHOLE, Room, Transfer
from swarm.frozen import frozen

ADDRESS = 0x3C
COLUMNS, PAGES = 128, 8
LETTERS_PER_LINE = COLUMNS // (WIDTH + 1)
LARGE_LETTERS = COLUMNS // (2 * (WIDTH + 1))
LINES = PAGES - 1
"""The first one is two pages high."""

BEHIND_S = 10.0
"""Seconds after which a picture that is not yet drawn counts as behind."""
RETRY_S = 10.0
"""Between looks for a display that is not there."""

_COMMANDS, _DATA = 0x00, 0x40
"""Control bytes: what follows is all commands, or all data."""

_SETUP = (
    (0xAE,),       # off while it shows what happens to be in its memory
    (0xD5, 0x80),  # clock: as after a reset
    (0xA8, 0x3F),  # 64 rows
    (0xD3, 0x00),  # no offset
    (0x40,),       # first line 0
    (0x8D, 0x14),  # charge pump on: these modules have no supply of 7 V
    (0x20, 0x02),  # page addressing: the column counts up, the page stays
    (0xA1,),
    (0xC8,),       # connector on top
    (0xDA, 0x12),  # wiring of a panel with 64 rows
    (0x81, 0xCF),  # contrast
    (0xD9, 0xF1),  # precharge for the charge pump
    (0xDB, 0x40),
    (0xA4,),
    (0xA6,),       # show the memory, a set bit is bright
)  # fmt: skip
"""Commands, each with its argument."""
SETUP = bytes((_COMMANDS, *(byte for command in _SETUP for byte in command)))
_ON = bytes((_COMMANDS, 0xAF))

SLICE = 26
"""Columns of a transfer at most."""
_GAP = 5
"""Columns in a row that have not changed, from which on a new address (5 bytes on the wire) is cheaper."""
_UNKNOWN = -1
"""A column of the display's memory after power came on."""
assert max(len(SETUP), 1 + SLICE) <= LONGEST


@frozen
class ScreenText:
    """The lines for `Screen.show` that the bridge hands to the loop."""

    lines: tuple[str, ...]


_SPREAD = tuple(sum(0b11 << (2 * bit) for bit in range(4) if nibble >> bit & 1) for nibble in range(16))
"""Four points as eight."""


def render(line: str) -> bytes:
    """Draw the first letters of `line` as a page of the display."""
    columns = b"".join(b"\0" + LETTERS.get(letter, UNKNOWN) for letter in line[:LETTERS_PER_LINE])
    return columns.ljust(COLUMNS, b"\0")


def render_large(line: str) -> tuple[bytes, bytes]:
    """Return a line in double size, as two pages; a line that does not fit is drawn in normal size."""
    if len(line) > LARGE_LETTERS:
        return render(line), bytes(COLUMNS)
    small = render(line)[: COLUMNS // 2]
    upper = bytes(_SPREAD[column & 15] for column in small for _ in range(2))
    lower = bytes(_SPREAD[column >> 4] for column in small for _ in range(2))
    return upper, lower


class Screen:
    """A slack task: brings the text of `show` to the display, the slices that changed."""

    def __init__(self, now: float) -> None:
        self.present: bool | None = None
        """None until it was looked for."""
        self.drawn = False
        """Whether it shows what it shall."""
        self._begun: float | None = None
        """Since when it does not show what it shall."""
        self._lines: tuple[str, ...] = ("",) * LINES
        self._wanted = [bytes(COLUMNS)] * PAGES
        self._shown = [[_UNKNOWN] * COLUMNS for _ in range(PAGES)]
        self._look_at = now
        self._lit = False
        self._commands = 0
        """The number of commands of the set-up that were sent. `_sent` counts those in the last transfer."""
        self._sent = 0
        self._slice: tuple[int, int, bytes] | None = None
        """Page, column and columns that come next; their address has been sent when `_pointer` says so."""
        self._pointer = (0, COLUMNS)

    def show(self, lines: Sequence[str]) -> None:
        """Show this text from now on: the first line large, then up to six."""
        lines = tuple(lines[:LINES]) + ("",) * (LINES - len(lines))
        for number, line in enumerate(lines):
            if line == self._lines[number]:
                continue
            if number == 0:
                self._wanted[0], self._wanted[1] = render_large(line)
            else:
                self._wanted[number + 1] = render(line)
            self.drawn = False
        self._lines = lines

    def behind(self, now: float) -> bool:
        """Return whether it has been drawn for so long that nobody waits for it."""
        return bool(self.present) and self._begun is not None and now - self._begun >= BEHIND_S

    def next(self, now: float, room: Room = WHOLE) -> Transfer | None:
        if not self.present:
            return self._setup(room) if now >= self._look_at else None
        self._slice = None if self.drawn else self._changed(max(1, room.send - 1))
        self.drawn = self._slice is None
        if self.drawn:
            self._begun = None
        elif self._begun is None or now < self._begun:
            self._begun = now
        if self._slice is None:
            return None if self._lit else Transfer(ADDRESS, _ON)
        page, column, data = self._slice
        if self._pointer != (page, column):
            return Transfer(ADDRESS, bytes((_COMMANDS, 0xB0 | page, column & 0x0F, 0x10 | column >> 4)))
        return Transfer(ADDRESS, bytes((_DATA,)) + data)

    def take(self, data: bytes, now: float) -> None:
        del data, now
        if not self.present:
            self._commands += self._sent
            if self._commands == len(_SETUP):
                self.present, self._lit, self.drawn = True, False, False
                self._shown = [[_UNKNOWN] * COLUMNS for _ in range(PAGES)]
                self._pointer = (0, COLUMNS)
        elif self._slice is None:
            self._lit = True
        elif self._pointer != self._slice[:2]:
            self._pointer = self._slice[:2]
        else:
            page, column, columns = self._slice
            end = column + len(columns)
            self._shown[page][column:end] = columns
            self._pointer = (page, end)  # the column counted up

    def fail(self, error: OSError, now: float) -> None:
        """See `SlackTask`. It is set up anew when it is back: it may have been without power."""
        del error
        self.present, self.drawn, self._look_at, self._commands = False, False, now + RETRY_S, 0

    def _setup(self, room: Room) -> Transfer:
        """Return as many commands of the set-up as fit into `room`, at least one."""
        data = bytes((_COMMANDS,))
        self._sent = 0
        for command in _SETUP[self._commands :]:
            if self._sent and len(data) + len(command) > room.send:
                break
            data += bytes(command)
            self._sent += 1
        return Transfer(ADDRESS, data)

    def _changed(self, most: int) -> tuple[int, int, bytes] | None:
        """Return the first columns that differ from what is shown, `most` at most, or None."""
        for page, (wanted, shown) in enumerate(zip(self._wanted, self._shown, strict=True)):
            if list(wanted) == shown:
                continue
            begin = next(n for n in range(COLUMNS) if wanted[n] != shown[n])
            if self._pointer[0] == page and 0 <= begin - self._pointer[1] < _GAP:
                begin = self._pointer[1]
            end = begin + 1
            for n in range(begin, min(COLUMNS, begin + min(most, SLICE))):
                if wanted[n] != shown[n]:
                    end = n + 1
                elif n - end >= _GAP:
                    break
            return page, begin, wanted[begin:end]
        return None
