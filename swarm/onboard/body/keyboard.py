"""The keys of a terminal one by one, or the bytes of a pipe; the terminal is as before afterwards, however it ends."""

import contextlib
import os
import select
import signal
import termios
import tty
from collections.abc import Iterator
from typing import TextIO

_CHUNK = 64
_SEQUENCES = {b"\x1b[A": "up", b"\x1b[B": "down", b"\x1b[C": "right", b"\x1b[D": "left"}
"""The bytes that terminals send for arrow keys (ECMA-48, normal cursor keys)."""
_SEQUENCES |= {sequence.replace(b"[", b"O"): key for sequence, key in _SEQUENCES.items()}
"""Bytes that terminals send for arrow keys with application cursor keys."""


def split(data: bytes) -> list[str]:
    """Return the names of the keys in what a terminal has sent: one letter each, or up, down, left or right.

    Bytes that are no key of ours are left out; a lone escape is `escape`.
    """
    keys: list[str] = []
    at = 0
    while at < len(data):
        if (arrow := _SEQUENCES.get(data[at : at + 3])) is not None:
            keys.append(arrow)
            at += 3
        elif data[at] == 0x1B and data[at + 1 : at + 2] in (b"[", b"O"):
            at += 2
            while at < len(data) and not 0x40 <= data[at] <= 0x7E:  # parameters of another key's sequence
                at += 1
            at += 1
        else:
            keys += ["escape"] if data[at] == 0x1B else [chr(data[at])] if 0x20 <= data[at] < 0x7F else []
            keys += ["enter"] if data[at] in b"\r\n" else []
            at += 1
    return keys


class Keyboard:
    """The keys that are pressed on a stream; `ended` where none will come any more."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self.ended = False

    @contextlib.contextmanager
    def raw(self) -> Iterator[None]:
        """Have single keys in place of lines, without echo, as long as the stream is a terminal.

        Restores the terminal at the end, also by SIGTERM and SIGHUP, which become `KeyboardInterrupt` meanwhile.
        """
        if not self._stream.isatty():
            yield
            return
        saved = termios.tcgetattr(self._stream)
        handlers = {number: signal.signal(number, _interrupt) for number in (signal.SIGTERM, signal.SIGHUP)}
        try:
            tty.setcbreak(self._stream)
            yield
        finally:
            with contextlib.suppress(termios.error):  # the terminal itself is gone
                termios.tcsetattr(self._stream, termios.TCSADRAIN, saved)
            for number, handler in handlers.items():
                signal.signal(number, handler)

    def read(self, seconds: float) -> list[str]:
        """Return the keys that come within that time, at once when there are some."""
        if self.ended or not select.select([self._stream], [], [], max(0.0, seconds))[0]:
            return []
        try:
            data = os.read(self._stream.fileno(), _CHUNK)
        except OSError:  # the terminal was closed
            data = b""
        self.ended = not data
        return split(data)


def _interrupt(*_: object) -> None:
    raise KeyboardInterrupt
