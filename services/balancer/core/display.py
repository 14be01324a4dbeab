"""The display, an SSD1306 of 128 x 64 points: text as columns, and only what changed as slices (datasheet 8, 9).

Its memory is 8 pages of 128 columns; a byte is a column of a page. A page is cut into five slices of 26 columns, so
that one with its address takes 3.0 ms at 100 kHz. A full picture is 50 transfers; a changed word two or three.
"""

from collections.abc import Sequence

from services.balancer.core.font import LETTERS, UNKNOWN, WIDTH
from services.balancer.core.transfers import LONGEST, Transfer
from swarm.frozen import frozen

ADDRESS = 0x3C
COLUMNS, PAGES = 128, 8
LETTERS_PER_LINE = COLUMNS // (WIDTH + 1)
LARGE_LETTERS = COLUMNS // (2 * (WIDTH + 1))
LINES = PAGES - 1
"""The first one is two pages high."""

RETRY_S = 10.0
"""Between looks for a display that is not there."""

_COMMANDS, _DATA = 0x00, 0x40
"""Control bytes: what follows is all commands, or all data."""

SETUP = bytes((
    _COMMANDS,
    0xAE,        # off while it shows what happens to be in its memory
    0xD5, 0x80,  # clock: as after a reset
    0xA8, 0x3F,  # 64 rows
    0xD3, 0x00,  # no offset
    0x40,        # first line 0
    0x8D, 0x14,  # charge pump on: these modules have no supply of 7 V
    0x20, 0x02,  # page addressing: the column counts up, the page stays
    0xA1, 0xC8,  # connector on top
    0xDA, 0x12,  # wiring of a panel with 64 rows
    0x81, 0xCF,  # contrast
    0xD9, 0xF1,  # precharge for the charge pump
    0xDB, 0x40,
    0xA4, 0xA6,  # show the memory, a set bit is bright
))  # fmt: skip
_ON = bytes((_COMMANDS, 0xAF))

SLICE = 26
_SLICES = tuple((page, column) for page in range(PAGES) for column in range(0, COLUMNS, SLICE))
assert max(len(SETUP), 1 + SLICE) <= LONGEST


@frozen
class ScreenText:
    """What the bridge hands the loop: lines for `Screen.show`."""

    lines: tuple[str, ...]


_SPREAD = tuple(sum(0b11 << (2 * bit) for bit in range(4) if nibble >> bit & 1) for nibble in range(16))
"""Four points as eight."""


def render(line: str) -> bytes:
    """A page with the first letters of `line`."""
    columns = b"".join(b"\0" + LETTERS.get(letter, UNKNOWN) for letter in line[:LETTERS_PER_LINE])
    return columns.ljust(COLUMNS, b"\0")


def render_large(line: str) -> tuple[bytes, bytes]:
    """The same in double size, as two pages; a line that does not fit comes in normal size."""
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
        self._lines: tuple[str, ...] = ("",) * LINES
        self._wanted = [bytes(COLUMNS)] * PAGES
        self._shown: list[bytearray | None] = [None] * PAGES
        self._look_at = now
        self._lit = False
        self._slice = -1
        """The one under way; its address has been sent when `_pointer` says so."""
        self._pointer = -1
        self._data = b""

    def show(self, lines: Sequence[str]) -> None:
        """From now on this text: the first line large, then up to six."""
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

    def next(self, now: float) -> Transfer | None:
        """See `SlackTask`."""
        if not self.present:
            return Transfer(ADDRESS, SETUP) if now >= self._look_at else None
        if self._slice < 0 and not self.drawn:
            self._slice = self._changed()
            self.drawn = self._slice < 0
        if self._slice < 0:
            return None if self._lit else Transfer(ADDRESS, _ON)
        page, column = _SLICES[self._slice]
        if self._pointer != self._slice:
            return Transfer(ADDRESS, bytes((_COMMANDS, 0xB0 | page, column & 0x0F, 0x10 | column >> 4)))
        self._data = self._wanted[page][column : column + SLICE]
        return Transfer(ADDRESS, bytes((_DATA,)) + self._data)

    def take(self, data: bytes, now: float) -> None:
        """See `SlackTask`."""
        del data, now
        if not self.present:
            self.present, self._lit, self.drawn = True, False, False
            self._shown = [None] * PAGES
            self._slice = self._pointer = -1
        elif self._slice < 0:
            self._lit = True
        elif self._pointer != self._slice:
            self._pointer = self._slice
        else:
            page, column = _SLICES[self._slice]
            shown = self._shown[page]
            if shown is None:
                # Its memory is random at first: no column of it counts as shown before it was written.
                shown = self._shown[page] = bytearray(byte ^ 0xFF for byte in self._wanted[page])
            shown[column : column + SLICE] = self._data
            # The column counted up; where the page goes on, so does the next slice.
            self._pointer = self._slice + 1 if column + SLICE < COLUMNS else -1
            self._slice = -1

    def fail(self, error: OSError, now: float) -> None:
        """See `SlackTask`. It is set up anew when it is back: it may have been without power."""
        del error
        self.present, self.drawn, self._look_at = False, False, now + RETRY_S

    def _changed(self) -> int:
        for number, (page, column) in enumerate(_SLICES):
            shown = self._shown[page]
            if shown is None or shown[column : column + SLICE] != self._wanted[page][column : column + SLICE]:
                return number
        return -1
