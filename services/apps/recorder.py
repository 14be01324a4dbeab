"""The trajectory as CSV, a line an iteration, written as it happens: a kill loses one line at most.

Columns: k, t (monotonic s at which state k was computed), the shared fields, the results as `result.NAME`.
Floats are written by repr, so equal text means equal bits. A restarted process writes its line once more; it
is the same.
"""

import logging
import os
from collections import Counter
from collections.abc import Iterable, Mapping
from pathlib import Path

from swarm.codec import Value
from swarm.core.state import Schema

_log = logging.getLogger("record")


class Recorder:
    """Appends to one file. Losing the recording does not stop a run: it is logged once and counted."""

    def __init__(self, path: Path, schema: Schema, counters: Counter[str], *, append: bool) -> None:
        """`append`: go on with the file of an earlier process of this run; otherwise begin it anew."""
        self._path = path
        self._schema = schema
        self._counters = counters
        self._headed = False
        self._file: int | None = None
        try:
            self._file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o664)
            self._end = self._whole_lines(self._file) if append else 0
            self._headed = self._end > 0
            os.ftruncate(self._file, self._end)
        except OSError as error:
            self._lose(error)

    def write(self, k: int, t: float, state: Mapping[str, Value], result: Mapping[str, Value]) -> None:
        """Append the line of iteration k."""
        text = "" if self._headed else self._header(result)
        text += _line((k, t, *_flat(state.values()), *_flat(result.values())))
        data = text.encode()
        if self._file is None:
            self._counters["records_lost"] += 1
            return
        try:
            written = os.pwrite(self._file, data, self._end)
            if written < len(data):
                os.ftruncate(self._file, self._end)  # no half lines: the next one may fit
                raise OSError(None, "the disk is full")  # noqa: TRY301
        except OSError as error:
            self._lose(error)
            return
        self._headed = True
        self._end += written

    def close(self) -> None:
        """Close the file."""
        if self._file is not None:
            os.close(self._file)

    def _header(self, result: Mapping[str, Value]) -> str:
        shared = [column for field in self._schema.fields for column in field.columns]
        results = []
        for name, value in result.items():
            width = len(value) if isinstance(value, tuple) else None
            results += [f"result.{name}"] if width is None else [f"result.{name}[{i}]" for i in range(width)]
        return _line(("k", "t", *shared, *results))

    def _whole_lines(self, file: int) -> int:
        """Where the last whole line ends."""
        size = os.fstat(file).st_size
        tail = os.pread(file, 65536, max(0, size - 65536))
        return size - len(tail) + tail.rfind(b"\n") + 1

    def _lose(self, error: OSError) -> None:
        if not self._counters["records_lost"]:
            _log.warning("%s cannot be recorded, the run goes on: %s", self._path, error.strerror)
        self._counters["records_lost"] += 1


def _flat(values: Iterable[Value]) -> Iterable[Value]:
    for value in values:
        if isinstance(value, tuple):
            yield from value
        else:
            yield value


def _line(cells: Iterable[Value]) -> str:
    return ",".join(_cell(cell) for cell in cells) + "\n"


def _cell(value: Value) -> str:
    if not isinstance(value, str):
        return repr(value)
    quoted = value.replace('"', '""').replace("\n", " ").replace("\r", " ")
    return f'"{quoted}"' if quoted != value or "," in value else value
