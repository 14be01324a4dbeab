"""A recording on disk: what is written is kept in memory and put into the file by a thread of its own, once a second.

Nobody who records ever waits for a disk (an SD card may take seconds). Whoever reads the file of a killed process
misses a second; with a journal the next process of the run puts that in, too. Losing the recording stops nothing:
it is logged once and counted.
"""

import contextlib
import itertools
import logging
import os
import threading
import time
from collections import Counter
from collections.abc import Callable, Mapping
from itertools import pairwise
from pathlib import Path

from swarm import __version__
from swarm.errors import LocalError, RecordingError
from swarm.files import free_space
from swarm.recording.budget import hold
from swarm.recording.core import mcap
from swarm.recording.core.writer import ExistingContent, Writer
from swarm.recording.journal import NO_OWNER, Journal, owner_of
from swarm.recording.survey import survey

FLUSH_S = 1.0
"""Seconds between two writes to the file."""
SYNC_S = 10.0
"""Seconds between two waits for the disk itself: what a robot loses at most when its battery falls out."""

MIN_FREE = 64 * 1024 * 1024
"""Bytes that stay free on the disk, because the robot needs them more than a recording."""

MAX_WAITING = 1024 * 1024
"""The most bytes that wait in memory for a slow or full disk. Beyond that, messages are lost."""

LIBRARY = f"balboa-swarm {__version__}"

UNRECORDED = "nothing is recorded"
"""The first words of an app's status while nothing can be recorded."""

_log = logging.getLogger("record")


def check_room(folder: Path) -> None:
    """Raise `LocalError` where the disk of a folder has so little room that no file in it would be written."""
    if free_space(folder) < MIN_FREE:
        raise LocalError(
            f"{folder}: less than {MIN_FREE >> 20} MiB are free on its disk, so nothing could be recorded: make room, "
            "or name a folder on another disk"
        )


def set_aside(path: Path, reason: Exception) -> None:
    """Give a file that cannot be read another name, so that it is not overwritten. Raises `OSError`."""
    names = itertools.chain([".damaged"], (f".damaged{number}" for number in itertools.count(2)))
    aside = next(free for name in names if not (free := path.with_suffix(name)).exists())
    _log.warning("%s: %s; it is now %s", path, reason, aside.name)
    path.rename(aside)


class RecordingFile:
    """One file that grows. All methods may be called from any thread, and none of them waits for the disk but `flush`
    and `close`."""

    def __init__(
        self,
        path: Path,
        counters: Counter[str],
        *,
        append: bool,
        journal: Path | None = None,
        min_free: int = MIN_FREE,
    ) -> None:
        """`append`: go on with the file of an earlier process of this run, otherwise begin it anew. `journal`: a file
        in memory for what has not reached the disk yet."""
        self._path = path
        self._counters = counters
        self._min_free = min_free
        self._lock = threading.Lock()  # around the writer
        self._disk = threading.Lock()  # around the file; taken first
        self._written = 0
        self._unwritten = b""
        self._due = False
        """Whether the journal's other half still waits for the disk."""
        self._restoring = False
        """Whether the journal still holds what an earlier process did not write: it takes nothing else until then."""
        self._told = False
        self.problem = ""
        """Why nothing is written at the moment; empty while all is well."""
        self._file: int | None = None
        self._journal = self._open_journal(journal)
        self._owner = NO_OWNER
        """The owner of this file's records in the journal."""
        left: list[tuple[int, bytes]] = []
        known = ExistingContent()
        try:
            self._file = os.open(path, os.O_RDWR | os.O_CREAT, 0o664)
            hold(self._file)
            if append and self._journal is not None:
                left = self._journal.left(owner_of(self._file))
            if append:
                known = self._found(left[0][0] if left else None)
            self._owner = owner_of(self._file)
            os.ftruncate(self._file, known.position)
        except OSError as error:
            self._let_go()  # what is there is not overwritten, though it could not be read
            self._lose(error.strerror or str(error))
        self._written = known.position
        self._linked = max(len(known.checkpoints) - 2, 0)
        """Checkpoints whose link to the next one is in the file; the process before may have left out its last."""
        self.epoch_ns = time.time_ns() - time.monotonic_ns()
        """The clock's zero in time of day, for people: nothing is computed with it."""
        self._writer = Writer(LIBRARY, epoch_ns=self.epoch_ns, known=known, keep=self._keep)
        self._restore(left)
        self.feed: Callable[[], None] = lambda: None
        """Called before each write to the file: puts in what waits elsewhere."""
        self.watched: Callable[[str], None] = lambda problem: None
        """Called with `problem` once a second."""
        self.tidy: Callable[[], object] = lambda: None
        """Called now and then (each `SYNC_S`): keeps the disk in order."""
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._loop, name="recording", daemon=True)
        self._thread.start()

    def metadata(self, name: str, entries: Mapping[str, str]) -> None:
        """Note something about the whole recording."""
        with self._lock:
            self._writer.metadata(name, entries)

    def write(self, topic: str, t: float, message: object, name: str = "") -> None:
        """Record a message; see `Writer.write`."""
        with self._lock:
            if self._file is None or self._writer.waiting + len(self._unwritten) > MAX_WAITING:
                self._counters["records_lost"] += 1
                return
            self._writer.write(topic, t, message, name)

    def lose(self, count: int) -> None:
        """Count messages that were lost before they came here."""
        with self._lock:
            self._counters["records_lost"] += count

    def flush(self) -> None:
        """Put into the file what was written so far."""
        with self._disk:
            self.feed()
            with self._lock:
                self._writer.cut()
                self._unwritten += self._writer.take()
                if self._journal is not None and self._unwritten and not self._due and not self._restoring:
                    self._journal.turn(self._written + len(self._unwritten))
                    self._due = True
            self._store()

    def close(self) -> None:
        self._ending.set()
        self._thread.join()
        self.flush()
        with self._disk:
            if self._file is None:
                return
            self._finish(self._file)
            with contextlib.suppress(OSError):
                os.fdatasync(self._file)
            os.close(self._file)
            self._file = None
            if self._journal is not None:
                self._journal.close()

    def _finish(self, file: int) -> None:
        """Write the summary, piece by piece: that of a long recording is large. Without room for it the file stays
        without."""
        try:
            for piece in self._writer.finish(lambda at, length: os.pread(file, length, at)):
                if self._unwritten:
                    return
                self._unwritten = piece
                self._store()
        except (OSError, RecordingError) as error:
            _log.warning("%s: the index cannot be written: %s", self._path, error)

    def _open_journal(self, path: Path | None) -> Journal | None:
        if path is None:
            return None
        try:
            return Journal(path)
        except OSError as error:
            _log.warning("%s: %s; a process that is killed loses a second of its recording", path, error.strerror)
            with contextlib.suppress(OSError):
                path.unlink()  # the next process is not to take what an earlier one has left for ours
            return None

    def _restore(self, left: list[tuple[int, bytes]]) -> None:
        """Write what an earlier process had only in its journal. It stays there until it is in the file: this process
        may be killed, too, and the next one begins where this one did."""
        if self._journal is None:
            return
        self._restoring = bool(left)
        for _, records in left:
            for at, _, content in mcap.whole_records(records):
                try:
                    self._writer.restore(records[at : at + mcap.HEAD.size + len(content)])
                except RecordingError as error:
                    _log.warning("%s: a record of the process before cannot be put in: %s", self._path, error)
        if left:
            self._writer.cut()
            self._unwritten = self._writer.take()
            self._store()
        else:
            self._journal.begin(self._written, self._owner)

    def _keep(self, record: bytes) -> None:
        if self._journal is not None and not self._restoring:
            self._journal.add(record)

    def _found(self, limit: int | None) -> ExistingContent:
        """Return the content that an earlier process has left, up to `limit`, where its journal goes on. A file in
        another format is put aside, not overwritten."""
        assert self._file is not None
        try:
            return survey(self._file, limit)
        except RecordingError as error:
            self._let_go()
            set_aside(self._path, error)
            self._file = os.open(self._path, os.O_RDWR | os.O_CREAT, 0o664)
            hold(self._file)
            return ExistingContent()

    def _let_go(self) -> None:
        if self._file is not None:
            os.close(self._file)
            self._file = None

    def _loop(self) -> None:
        """Write once a second until closed. A defect ends the recording, never the app whose run is recorded."""
        try:
            self._write_on()
        except Exception as error:  # noqa: BLE001 - whatever it is, the run goes on
            _log.exception("the recording thread has a defect")
            self._lose(f"defect of the recording: {error!r}")
            self.watched(self.problem)

    def _write_on(self) -> None:
        synced = 0.0
        while not self._ending.wait(FLUSH_S):
            self.flush()
            self.watched(self.problem)
            synced += FLUSH_S
            if synced >= SYNC_S and self._file is not None:
                synced = 0.0
                try:
                    os.fdatasync(self._file)
                except OSError as error:
                    self._lose(error.strerror or str(error))
                self.tidy()

    def _store(self) -> None:
        """Write what is there. Where the disk takes less, the rest stays for the next time."""
        data = self._unwritten
        if not data or self._file is None:
            return
        try:
            if free_space(self._file) < self._min_free:
                self._lose(f"less than {self._min_free >> 20} MiB are free on its disk")
                return
            count = os.pwrite(self._file, data, self._written)
        except OSError as error:
            self._lose(error.strerror or str(error))
            return
        self._written += count
        self._unwritten = data[count:]
        if self._unwritten:
            self._lose("the disk is full")
            return
        self.problem = ""
        self._link()
        if self._journal is not None:
            if self._restoring:
                with self._lock:
                    self._journal.begin(self._written, self._owner)
                    self._restoring = False
            else:
                self._journal.stored()
            self._due = False

    def _link(self) -> None:
        """Let each checkpoint in the file name the next one."""
        assert self._file is not None
        for at, after in pairwise(self._writer.checkpoints[self._linked :]):
            place, packed = mcap.link(at, after)
            try:
                os.pwrite(self._file, packed, place)
            except OSError as error:
                self._lose(error.strerror or str(error))
                return
            self._linked += 1

    def _lose(self, reason: str) -> None:
        self.problem = reason
        if not self._told:
            self._told = True
            _log.warning("%s cannot be recorded, the run goes on: %s", self._path, reason)
