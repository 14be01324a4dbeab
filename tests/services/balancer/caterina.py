"""A stand-in for Pololu's bootloader (Caterina), at the bytes of its USB serial port, and on a pseudo-terminal.

It keeps what makes that bootloader difficult: one command for each packet of 16 bytes, what follows in it is thrown
away; a block write erases its page first; it leaves for the program after 8 s without a block command, but only while
the first word of the flash is not erased; erasing takes the whole of the flash below the bootloader.
"""

import contextlib
import os
import select
import threading
import time
import tty
from collections.abc import Callable, Generator

PACKET = 16
FLASH = 28672
PAGE = 128
TIMEOUT_S = 8.0
NEARLY_S = 7.5

Step = Generator[None, int, bytes]
"""Is sent the bytes that follow a command, one by one, and returns the answer."""


class Caterina:
    """The commands. `flash` is what is in the chip."""

    def __init__(self, *, signature: bytes = b"\x1e\x95\x87") -> None:
        self.flash = bytearray(b"\xff" * FLASH)
        self.signature = signature
        self.break_at: Callable[[int, bytes], bytes] = lambda address, data: data
        """What really comes to lie in a page: a worn flash."""
        self.written: list[int] = []
        self._address = 0
        self._idle = 0.0
        self._command: Step | None = None

    @property
    def has_program(self) -> bool:
        return self.flash[:2] != b"\xff\xff"

    def tick(self, seconds: float) -> bool:
        """Time passes; True when it has left for the program."""
        if self.has_program:
            self._idle += seconds
        return self._idle > TIMEOUT_S

    def receive(self, data: bytes) -> bytes:
        """What the host writes at once; the answers."""
        answers = b""
        for start in range(0, len(data), PACKET):
            answers += self._packet(data[start : start + PACKET])
        return answers

    def _packet(self, packet: bytes) -> bytes:
        rest = list(packet)
        if self._command is None:
            self._command = self._obey(rest.pop(0))
            if (answer := self._next(None)) is not None:
                return answer
        while rest:
            if (answer := self._next(rest.pop(0))) is not None:
                return answer  # and the rest of the packet is gone
        return b""

    def _next(self, byte: int | None) -> bytes | None:
        assert self._command is not None
        try:
            if byte is None:
                next(self._command)
            else:
                self._command.send(byte)
        except StopIteration as end:
            self._command = None
            return bytes(end.value)
        return None

    def _obey(self, command: int) -> Step:
        match chr(command):
            case "E":
                self._idle = NEARLY_S
                return b"\r"
            case "T":
                yield
                return b"\r"
            case "L" | "P":
                return b"\r"
            case "t":
                return b"\x44\x00"
            case "a":
                return b"Y"
            case "A":
                high = yield
                low = yield
                self._address = high << 9 | low << 1
                return b"\r"
            case "p":
                return b"S"
            case "S":
                return b"CATERIN"
            case "V":
                return b"10"
            case "s":
                return self.signature[::-1]
            case "e":
                self.flash[:] = b"\xff" * FLASH
                return b"\r"
            case "r" | "F" | "N" | "Q":
                return b"\xff"
            case "b":
                return b"Y" + PAGE.to_bytes(2)
            case "B" | "g":
                self._idle = 0.0
                return (yield from self._block(command))
            case "\x1b":
                return b""
            case _:
                return b"?"

    def _block(self, command: int) -> Step:
        high = yield
        low = yield
        size, kind = high << 8 | low, (yield)
        if kind != ord("F"):
            return b"?"
        start = self._address
        self._address += size
        if command == ord("g"):
            return bytes(self.flash[start : start + size])
        page = bytearray(b"\xff" * PAGE)
        for at in range(size):
            page[(start + at) % PAGE] = yield
        begin = start - start % PAGE
        self.flash[begin : begin + PAGE] = self.break_at(begin, bytes(page))
        self.written.append(begin)
        return b"\r"


class Port:
    """A Caterina at a pseudo-terminal, until closed, or until its cable is pulled after so many bytes."""

    def __init__(self, caterina: Caterina, *, bytes_until_pulled: int | None = None) -> None:
        self.caterina = caterina
        self._left = bytes_until_pulled
        self._master, slave = os.openpty()
        tty.setraw(slave)
        self.path = os.ttyname(slave)
        self._slave = slave
        self._end, self._tell = os.pipe()
        self._thread = threading.Thread(target=self._serve)
        self._thread.start()

    def _serve(self) -> None:
        then = time.monotonic()
        while True:
            ready, _, _ = select.select([self._master, self._end], [], [], 0.05)
            now = time.monotonic()
            self.caterina.tick(now - then)
            then = now
            if self._end in ready:
                return
            if not ready:
                continue
            data = os.read(self._master, 4096)
            if self._left is not None:
                self._left -= len(data)
                if self._left < 0:
                    os.close(self._master)
                    return
            os.write(self._master, self.caterina.receive(data))

    def __enter__(self) -> "Port":
        return self

    def __exit__(self, *_: object) -> None:
        os.close(self._tell)
        self._thread.join()
        for descriptor in (self._master, self._slave, self._end):
            with contextlib.suppress(OSError):
                os.close(descriptor)
