"""A robot's recordings and journal into folders of the laptop: what is missing of them, checked, and only then deleted.

`collect` and `journal` know what is to come; here are the files and the connection.
"""

import contextlib
import hashlib
import os
import shlex
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

from laptop.fleet.core import collect
from laptop.fleet.core.collect import File, FileData, FileEnd, Stream
from laptop.fleet.files.journal import FIELDS, JournalMark, entry
from laptop.fleet.ssh.everyone import ReportProgress
from laptop.fleet.ssh.ssh import Host, HostError, Ssh, last_words
from laptop.fleet.units import JOURNAL_OF_ALL
from swarm.errors import RemoteError
from swarm.files import atomic_write, make_folder, sync_folder

JOURNAL = "journal"
"""Folder of the journals, beside those of the runs."""

_TOLD_EVERY = 10_000_000
"""Bytes between two reports of progress."""
_ACTIVE = "systemctl list-units --plain --no-legend --state=active,activating,reloading 'swarm-app@*'"


@dataclass
class FetchedRecordings:
    """The result of fetching one robot's recordings."""

    files: int = 0
    runs: set[str] = field(default_factory=set)
    received: int = 0
    """Bytes that crossed the network."""
    verified: dict[File, str] = field(default_factory=dict)
    """Checksum of each file whose copy here has the same checksum."""
    strange: list[str] = field(default_factory=list)
    """Unknown names, whose files stay where they are."""


class RecordingFetch:
    """Fetches one robot's recordings into `folder`/RUN."""

    def __init__(self, ssh: Ssh, host: Host, folder: Path, tell: ReportProgress) -> None:
        self._ssh, self._host, self._folder, self._tell = ssh, host, folder, tell
        self._got = FetchedRecordings()
        self._differs: set[File] = set()
        """Files that differ from another robot's file of the same name."""

    async def recordings(self, runs: list[str]) -> FetchedRecordings:
        """Bring what is missing here of the wanted runs, of all where none is named. Raises `HostError`."""
        try:
            found, self._got.strange = collect.parse_list(await self._run(collect.LIST))
            files = collect.of_runs(found, runs)
            await self._bring(files)
            # A copy that was not the robot's file was set aside, and is fetched anew: once.
            await self._bring([file for file in files if file not in self._got.verified])
        except OSError as error:
            raise HostError(f"{error.filename or self._folder}: cannot be kept here: {error.strerror}") from None
        except RemoteError as error:
            raise HostError(str(error)) from None
        self._got.files, self._got.runs = len(files), {file.run for file in files}
        if missing := [file.path for file in files if file not in self._got.verified]:
            raise HostError(f"{missing[0]} has changed on the robot while it was fetched: fetch again")
        return self._got

    async def delete(self) -> tuple[int, list[str]]:
        """Delete on the robot the files that have a verified copy here. Return how many were deleted, and the runs that
        still go on."""
        active = {line.split()[0] for line in (await self._ssh.check(self._host, _ACTIVE)).splitlines() if line.split()}
        running = sorted({file.run for file in self._got.verified if f"swarm-app@{file.app}.service" in active})
        todo = [(file, digest) for file, digest in self._got.verified.items() if file.run not in running]
        feed = "".join(f"{digest} {file.size} {file.path}\n" for file, digest in todo)
        gone = (await self._run(collect.DELETE, feed.encode())).splitlines() if todo else []
        return len(gone), running

    async def journal(self) -> int:
        """Append new entries to the copy of the robot's journal, and return how many. Raises `HostError`."""
        try:
            return await self._journal()
        except OSError as error:
            raise HostError(f"{error.filename or self._folder}: cannot be kept here: {error.strerror}") from None

    async def _run(self, script: str, feed: bytes = b"") -> str:
        return await self._ssh.check(self._host, _as_root(script), feed=[feed])

    def _local(self, file: File) -> Path:
        """Return the path of the copy here: the robot's own, or one of a file that all robots have, as long as it is
        the same."""
        own, common = self._folder / file.own(self._host.robot), self._folder / file.path
        if own == common or own.exists() or file in self._differs:
            return own
        return common if common.is_file() and common.stat().st_size == file.size else own

    def _settle(self, file: File, path: Path, same: bool) -> None:
        """Put a file that has come to its end in its place. `same`: whether its sum is that of the robot's file."""
        common = self._folder / file.path
        if not same and path == common and not file.is_of(self._host.robot):
            self._differs.add(file)
        elif not same:
            _set_aside(path)
        elif path != common:
            # A file that all robots have is kept once. Other data of another robot under that name are kept, too.
            try:
                os.link(path, common)
            except FileExistsError:
                pass
            except OSError:  # a stick's file system has no second names
                if not common.exists():
                    path.rename(common)
                    return
            if _sum(path) == _sum(common):
                path.unlink()

    async def _bring(self, files: list[File]) -> None:
        # The places are settled here: meanwhile the copy of another robot may come to lie there.
        places = {file: self._local(file) for file in files}
        have = {file.path: place.stat().st_size for file, place in places.items() if place.is_file()}
        wanted = collect.plan(files, have)
        if not wanted:
            return
        for each in wanted:
            if each.offset < have.get(each.file.path, 0):
                _set_aside(places[each.file])
        total = sum(each.file.size - each.offset for each in wanted)
        if total >= _TOLD_EVERY:
            self._tell(f"{len(wanted)} files, {total / 1e6:.1f} MB to come")
        stream, sink = Stream(wanted), _Sink(places, self._settle, self._got, _Progress(total, self._tell))
        try:
            done = await self._ssh.run(
                self._host,
                _as_root(collect.SEND),
                feed=[each.line for each in wanted],
                on_data=lambda data: sink.take(stream.receive(data)),
            )
        finally:
            sink.close()
        if not stream.finished:
            raise HostError(last_words(done.err) or "it stopped sending in the middle of it: fetch again")

    async def _journal(self) -> int:
        folder = self._folder / JOURNAL
        folder.mkdir(parents=True, exist_ok=True)
        text, place = folder / f"{self._host.robot}.log", folder / f"{self._host.robot}.mark"
        mark = JournalMark.of(place.read_text(errors="replace")) if place.exists() else JournalMark()
        count = 0
        with text.open("ab") as file:
            if file.tell() < mark.size:
                mark = JournalMark()  # the text was taken away: begin anew
            file.truncate(mark.size)  # text behind the mark has no cursor
            file.seek(mark.size)
            cursor = mark.cursor

            def line(data: str) -> None:
                nonlocal cursor, count
                if (found := entry(data)) is not None:
                    cursor, count = found[0], count + 1
                    file.write(found[1].encode() + b"\n")

            after = f" --after-cursor={shlex.quote(cursor)}" if cursor else ""
            command = f"sudo -n journalctl --no-pager --output=json --output-fields={FIELDS} {JOURNAL_OF_ALL}{after}"
            try:
                done = await self._ssh.run(self._host, command, on_line=line)
            finally:
                # The entries that have come stay, whatever happened: the next transfer goes on behind them.
                file.flush()
                os.fsync(file.fileno())
                atomic_write(place, JournalMark(file.tell(), cursor).text.encode())
        if done.code != 0:
            raise HostError(last_words(done.err) or f"journalctl: exit code {done.code}")
        return count


class _Sink:
    """Writes parts of the stream to files, and compares each whole file with the robot's sum."""

    def __init__(
        self,
        places: Mapping[File, Path],
        settle: Callable[[File, Path, bool], None],
        got: FetchedRecordings,
        report: "_Progress",
    ) -> None:
        self._places, self._settle, self._got, self._report = places, settle, got, report
        self._file: BinaryIO | None = None
        self._path = Path()

    def take(self, parts: Iterable[FileData | FileEnd]) -> None:
        """Write parts of the stream as they come."""
        for part in parts:
            file = part.wanted.file
            if isinstance(part, FileData):
                self._open(file).write(part.data)
                self._got.received += len(part.data)
                self._report.add(len(part.data))
            elif part.sum is None:
                self.close()
            else:
                self._open(file)
                self.close()
                same = _sum(self._path) == part.sum
                if same:
                    self._got.verified[file] = part.sum
                self._settle(file, self._path, same)

    def close(self) -> None:
        """Bring what was written to the disk."""
        if self._file is not None:
            with contextlib.closing(self._file) as file:
                self._file = None
                file.flush()
                os.fsync(file.fileno())
            sync_folder(self._path.parent)  # the robot may be told to delete its own copy now

    def _open(self, file: File) -> BinaryIO:
        if self._file is None:
            self._path = self._places[file]
            make_folder(self._path.parent)
            self._file = self._path.open("ab")
        return self._file


class _Progress:
    """Reports each ten megabytes what share of the files has come."""

    def __init__(self, total: int, tell: ReportProgress) -> None:
        self._total, self._tell = total, tell
        self._here = self._told = 0

    def add(self, size: int) -> None:
        self._here += size
        if self._here - self._told >= _TOLD_EVERY:
            self._told = self._here
            self._tell(f"{100 * self._here // self._total} % of {self._total / 1e6:.1f} MB")


def _as_root(script: str) -> str:
    return f"sudo -n nice -n 19 sh -c '{script.format(runs=collect.RUNS)}'"


def _sum(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _set_aside(path: Path) -> None:
    """Give a file that is not the robot's another name: its data may exist nowhere else."""
    number = next(number for number in range(1, 1 << 30) if not path.with_name(f"{path.name}~{number}").exists())
    path.rename(path.with_name(f"{path.name}~{number}"))
