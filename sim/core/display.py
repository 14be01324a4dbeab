"""An SSD1306 with its 128 x 64 points (datasheet 8.1.5, 9, 10), which keeps the picture for who wants to look at it."""

import itertools

COLUMNS, PAGES = 128, 8

_ARGUMENTS = {
    0x20: 1, 0x21: 2, 0x22: 2, 0x26: 6, 0x27: 6, 0x29: 5, 0x2A: 5, 0x81: 1, 0x8D: 1, 0xA3: 2, 0xA8: 1, 0xD3: 1, 0xD5: 1,
    0xD9: 1, 0xDA: 1, 0xDB: 1,
}  # fmt: skip
"""Bytes that follow a command."""
_PAGE_ADDRESSING = 2


class DisplayDevice:
    """An SSD1306 that has just been powered up: it is dark, and its memory holds anything."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Reset as when power comes on."""
        self._memory = [bytearray((37 * page + 11 * x) % 256 for x in range(COLUMNS)) for page in range(PAGES)]
        self._page = self._column = 0
        self._mode = _PAGE_ADDRESSING
        self._on = self._pump = self._mirrored = self._upside_down = False

    def write(self, data: bytes, now: float) -> None:
        """Take a control byte, then commands or data. With the top bit of the control byte set, one byte and the
        next control byte follow."""
        del now
        stream = iter(data)
        for control in stream:
            rest = list(itertools.islice(stream, 1)) if control & 0x80 else list(stream)
            if control & 0x40:
                self._draw(rest)
            else:
                self._obey(rest)

    def read(self, count: int, now: float) -> bytes:
        """Return the status: bit 6 = dark."""
        del now
        return bytes((0x00 if self._on else 0x40,)) * count

    def picture(self) -> list[str]:
        """Return 64 lines of 128 characters, `#` bright, as one sees the picture with the connector on top. A display
        that is off is all dark."""
        if not (self._on and self._pump):
            return ["." * COLUMNS] * (8 * PAGES)
        lines = []
        for y in range(8 * PAGES):
            row = self._memory[y // 8]
            lines.append("".join("#" if byte >> y % 8 & 1 else "." for byte in row))
        # 0xA1 and 0xC8 are how a panel is wired whose connector is on top.
        lines = lines if self._mirrored else [line[::-1] for line in lines]
        return lines if self._upside_down else lines[::-1]

    def _draw(self, data: list[int]) -> None:
        for byte in data:
            self._memory[self._page][self._column] = byte
            self._column = (self._column + 1) % COLUMNS
            if self._column == 0 and self._mode == 0:
                self._page = (self._page + 1) % PAGES

    def _obey(self, commands: list[int]) -> None:
        at = 0
        while at < len(commands):
            command = commands[at]
            arguments = commands[at + 1 : at + 1 + _ARGUMENTS.get(command, 0)]
            at += 1 + len(arguments)
            self._command(command, arguments)

    def _command(self, command: int, arguments: list[int]) -> None:
        if command <= 0x0F:
            self._column = (self._column & 0x70) | command
        elif command <= 0x17:
            self._column = (self._column & 0x0F) | (command & 0x07) << 4
        elif 0xB0 <= command <= 0xB7:
            self._page = command & 0x07
        elif command in (0xAE, 0xAF):
            self._on = command == 0xAF
        elif command in (0xA0, 0xA1):
            self._mirrored = command == 0xA1
        elif command in (0xC0, 0xC8):
            self._upside_down = command == 0xC8
        elif command == 0x20 and arguments:
            self._mode = arguments[0] & 3
        elif command == 0x8D and arguments:
            self._pump = bool(arguments[0] & 0x04)
