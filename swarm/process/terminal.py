"""Standard output and error of a process: text that others have named reaches them in printable form only.

`guard` is called once where a program begins. From then on everything that is written by `print`, `sys.stdout.write`,
`argparse` or a traceback goes through `swarm.process.text.printable`, so that no caller can forget it. Lines stay
lines: a table whose cells others have named is written by `write_lines`, which keeps each row on its line.
"""

import os
import sys
import typing
from collections.abc import Iterable, Sequence
from typing import Any, TextIO

from swarm.process.text import printable

BAR = 40
"""Characters of a bar."""


class Guarded:
    """A text stream that writes each line in printable form; in all else the stream that it was made from."""

    def __init__(self, stream: TextIO) -> None:
        self.stream = stream
        """Takes anything: only `steer` writes to it."""

    def write(self, text: str) -> int:
        """Write text; its line ends stay, all other control characters become visible."""
        self.stream.write("\n".join(printable(line, None) for line in text.split("\n")))
        return len(text)

    def writelines(self, lines: Iterable[str]) -> None:
        for line in lines:
            self.write(line)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.stream, name)


def guard() -> None:
    """Guard this process' standard output and error; once more does nothing."""
    _open_closed()
    if not isinstance(sys.stdout, Guarded):
        sys.stdout = typing.cast(TextIO, Guarded(sys.stdout))
    if not isinstance(sys.stderr, Guarded):
        sys.stderr = typing.cast(TextIO, Guarded(sys.stderr))


def _open_closed() -> None:
    """Open each standard stream to nowhere that the process was started without, as by the shell's `>&-`. Else the next
    file or socket takes its number, and gets what this process or a child prints."""
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.set_inheritable(os.open(os.devnull, os.O_RDWR), True)  # the lowest number that is free
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        if getattr(sys, name) is None:
            setattr(sys, name, open(number, "w" if number else "r", closefd=False))  # noqa: SIM115


def write_lines(lines: Iterable[str]) -> None:
    """Write each of these to standard output as one line."""
    sys.stdout.write("".join(printable(line, None) + "\n" for line in lines))


def columns(rows: Sequence[Sequence[str]], *, right: bool = False, rule: bool = False) -> list[str]:
    """Return a line for each row, its cells in columns that are as wide as their widest cell. `rule`: a line of dashes
    stands below the first."""
    widths = [max(map(len, cells)) for cells in zip(*rows, strict=True)]
    if rule:
        rows = [rows[0], ["-" * width for width in widths], *rows[1:]]
    lines = (
        "  ".join(cell.rjust(width) if right else cell.ljust(width) for cell, width in zip(row, widths, strict=True))
        for row in rows
    )
    return [line.rstrip() for line in lines]


def bar(stream: TextIO, done: int, count: int, text: str = "") -> None:
    """Draw a bar that grows over the line that the cursor is in; nothing where the stream is no terminal."""
    if stream.isatty():
        full = BAR * done // count
        steer(stream, f"\r[{'#' * full}{'.' * (BAR - full)}] {done}/{count}{text}")
        stream.flush()


def steer(stream: TextIO, codes: str) -> None:
    """Write control codes of our own, e.g. a carriage return, to a stream that may be guarded."""
    (stream.stream if isinstance(stream, Guarded) else stream).write(codes)
