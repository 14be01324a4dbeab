r"""The plan to fetch a robot's recordings: what is missing here, and how it comes. Lists, plans and the stream, without
IO.

The robot lists its files with their sizes. The laptop asks for each from where its own copy ends; the robot answers
with one stream, for each file in the order asked:

    "+\n", the bytes from the offset to the size, the SHA-256 of all bytes up to the size as `sha256sum` prints it
    "-\n" where the file has become shorter than that, or is gone

So what breaks in mid-transfer costs nothing that has arrived, and a copy counts only when its sum is the robot's.
"""

import re
from collections.abc import Iterator, Mapping, Sequence

from swarm.errors import RemoteError
from swarm.frozen import frozen

RUNS = "/var/lib/swarm/runs"
"""The directory in which a robot has a folder for each run, APP-NUMBER."""

_PART = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.:+-]{0,127}")
"""Allowed names of folders and files. None of them leads out of its folder or means something to a shell."""
_MAX_PARTS = 4
_MAX_DIGITS = 19
"""The most digits of a file's size: Python converts no text of more than 4300 digits."""
_SUM_LINE = re.compile(rb"([0-9a-f]{64})  -\n")
_SUM_SIZE = 68

LIST = 'cd {runs} 2>/dev/null || exit 0; find . -mindepth 2 -type f -printf "%s %P\\0"'
SEND = """cd {runs} || exit 1
while read -r offset size path; do
    if [ "$(stat -c %s -- "$path" 2>/dev/null || echo 0)" -ge "$size" ]; then
        echo +
        tail -c +$((offset + 1)) -- "$path" | head -c $((size - offset))
        head -c "$size" -- "$path" | sha256sum
    else
        echo -
    fi
done"""
DELETE = """cd {runs} || exit 1
while read -r sum size path; do
    if [ "$(stat -c %s -- "$path")" = "$size" ] && [ "$(sha256sum <"$path")" = "$sum  -" ]; then
        rm -f -- "$path" && echo "$path"
    fi
done
find . -mindepth 1 -type d -empty -delete"""
"""Commands for the robot's shell, in which `runs` is RUNS. They contain no single quote, because they are passed on in
single quotes."""


@frozen
class File:
    """One file of a run on a robot."""

    path: str
    """RUN/NAME, below RUNS."""
    size: int

    @property
    def run(self) -> str:
        return self.path.partition("/")[0]

    @property
    def app(self) -> str:
        """Return the app of the run."""
        return self.run.rpartition("-")[0]

    def is_of(self, robot: str) -> bool:
        """Return whether its name says that it is this robot's own; the others are the same on every robot of the
        run."""
        return self.path.rpartition("/")[2].startswith(f"{robot}.")

    def own(self, robot: str) -> str:
        """Return its path among those of other robots, whatever these have under the same name."""
        folder, _, name = self.path.rpartition("/")
        return self.path if self.is_of(robot) else f"{folder}/{robot}.{name}"


def parse_list(text: str) -> tuple[list[File], list[str]]:
    """Read the robot's answer to LIST. Return the files, and the paths that none of our programs makes; these files
    stay where they are.

    Raises `RemoteError` where it is no list.
    """
    files, strange = [], []
    for entry in text.split("\0")[:-1]:
        size, _, path = entry.partition(" ")
        if not size.isascii() or not size.isdecimal() or len(size) > _MAX_DIGITS:
            raise RemoteError(f"the list of its recordings cannot be read: {entry[:80]!r}")
        parts = path.split("/")
        if 2 <= len(parts) <= _MAX_PARTS and all(_PART.fullmatch(part) for part in parts):
            files.append(File(path, int(size)))
        else:
            strange.append(path)
    return sorted(files, key=lambda file: file.path), sorted(strange)


def of_runs(files: Sequence[File], wanted: Sequence[str]) -> list[File]:
    """Return the files of the runs that are named by folder or by app; all files where none is named."""
    return [file for file in files if not wanted or file.run in wanted or file.app in wanted]


@frozen
class Wanted:
    """A file that the robot is to send from an offset on."""

    file: File
    offset: int

    @property
    def line(self) -> bytes:
        """Return the request, as SEND reads it."""
        return f"{self.offset} {self.file.size} {self.file.path}\n".encode()


def plan(files: Sequence[File], have: Mapping[str, int]) -> list[Wanted]:
    """Return what to ask for; `have` gives the bytes that are here, by the robot's path. A copy that is longer than
    the file is no beginning of it, so the whole file is asked for."""
    return [Wanted(file, have.get(file.path, 0) if have.get(file.path, 0) <= file.size else 0) for file in files]


@frozen
class FileData:
    """Bytes of a file, to be appended."""

    wanted: Wanted
    data: bytes


@frozen
class FileEnd:
    """The end of a file, with the sum of all of its bytes on the robot; None where the robot has no such file."""

    wanted: Wanted
    sum: str | None


class Stream:
    """Takes the robot's answer to SEND apart."""

    def __init__(self, wanted: Sequence[Wanted]) -> None:
        self._todo = list(reversed(wanted))
        self._left: int | None = None
        """Bytes of the first file that have not arrived yet; None before the file's mark."""
        self._rest = b""

    @property
    def finished(self) -> bool:
        """Return whether everything has come."""
        return not self._todo

    def receive(self, data: bytes) -> Iterator[FileData | FileEnd]:
        """Take data of the stream and yield its parts. Raises `RemoteError` where the data is no answer to what was
        asked."""
        data = self._rest + data
        self._rest = b""
        while data and self._todo:
            wanted = self._todo[-1]
            if self._left is None:
                if len(data) < 2:
                    break
                mark, data = data[:2], data[2:]
                if mark == b"-\n":
                    self._todo.pop()
                    yield FileEnd(wanted, None)
                elif mark == b"+\n":
                    self._left = wanted.file.size - wanted.offset
                else:
                    raise RemoteError(f"what it sends is no file: {(mark + data)[:80]!r}")
            elif self._left:
                part, data = data[: self._left], data[self._left :]
                self._left -= len(part)
                yield FileData(wanted, part)
            else:
                if len(data) < _SUM_SIZE:
                    break
                found = _SUM_LINE.fullmatch(data[:_SUM_SIZE])
                if found is None:
                    raise RemoteError(f"{wanted.file.path}: no sum behind it, but {data[:_SUM_SIZE]!r}")
                data, self._left = data[_SUM_SIZE:], None
                self._todo.pop()
                yield FileEnd(wanted, found[1].decode())
        if data and not self._todo:
            raise RemoteError(f"it sends more than was asked for: {data[:80]!r}")
        self._rest = data
