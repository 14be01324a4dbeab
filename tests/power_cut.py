"""A double of the disk: it writes down what a program asks of the file system, and gives back every state in which a
power cut may leave the disk.

What was synced is there. Of what was not, anything may be: of what changed in a file all, nothing or one half, with
zeros where there was nothing before; of the changes of a folder's names, made in order, any first few. (A real disk is
kinder: ext4 orders data before names.)

    disk = Disk(tmp_path / "robot")
    with disk.recorded(monkeypatch):
        ... what a program does with files below `tmp_path / "robot"` ...
    for state in disk.states(): ...
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import pytest


class Killed(BaseException):
    """Stands for SIGKILL: whatever was under way does not go on."""


@dataclass
class _Inode:
    """A file: what is on the disk for certain, and what a process that reads it finds."""

    synced: bytes = b""
    now: bytes = b""

    def contents(self) -> list[bytes]:
        """What may be found after a power cut: of what has changed since the sync all, nothing, or one half."""
        if self.synced == self.now:
            return [self.now]
        old = self.synced[: len(self.now)].ljust(len(self.now), b"\0")
        changed = [at for at, (a, b) in enumerate(zip(old, self.now, strict=True)) if a != b]
        middle = (changed[0] + changed[-1] + 1) // 2 if changed else 0
        halves = [self.now[:middle] + old[middle:], old[:middle] + self.now[middle:]]
        return list(dict.fromkeys([self.synced, self.now, *halves]))


@dataclass(frozen=True)
class Link:
    """A symbolic link: there with its target, or not there."""

    target: str


@dataclass
class _Folder:
    """Names: those on the disk for certain, and the changes since."""

    synced: dict[str, Any] = field(default_factory=dict)
    changes: list[dict[str, Any]] = field(default_factory=list)

    @property
    def now(self) -> dict[str, Any]:
        return self.changes[-1] if self.changes else self.synced


class State(NamedTuple):
    """One way in which the disk may be found."""

    calls: int
    """Calls that were made before the cut."""
    cut: bool
    """Whether the power failed; else the process was killed, and the disk is as the process left it."""
    tree: dict[str, Any]
    """Names; bytes for a file, a tree for a folder, a `Link`."""

    def lay_out(self, place: Path) -> Path:
        """Write it into an empty folder."""
        shutil.rmtree(place, ignore_errors=True)
        _lay_out(self.tree, place)
        return place


def _lay_out(tree: dict[str, Any], place: Path) -> None:
    place.mkdir(parents=True)
    for name, content in tree.items():
        if isinstance(content, bytes):
            (place / name).write_bytes(content)
        elif isinstance(content, Link):
            (place / name).symlink_to(content.target)
        else:
            _lay_out(content, place / name)


class Disk:
    """The files below one folder."""

    def __init__(self, root: Path) -> None:
        """What is in `root` already is on the disk."""
        root.mkdir(parents=True, exist_ok=True)
        self.root = root
        self.calls: list[str] = []
        """The calls that changed or synced something, in words."""
        self.kill_after: int | None = None
        """After so many calls the process is killed: `Killed` is raised."""
        self._states: list[State] = []
        self._top = self._look(root)
        self._open: dict[int, Any] = {}
        self._note("begin")

    def states(self, after: int = 0) -> Iterator[State]:
        """Every state that a kill or a power cut may leave once at least `after` calls were made."""
        return (state for state in self._states if state.calls >= after)

    def _look(self, path: Path) -> Any:
        if path.is_symlink():
            return Link(str(path.readlink()))
        if path.is_dir():
            return _Folder({each.name: self._look(each) for each in path.iterdir()})
        data = path.read_bytes()
        return _Inode(data, data)

    def _note(self, call: str) -> None:
        """Keep the states that are possible after this call."""
        if call != "begin":
            self.calls.append(call)
        count = len(self.calls)
        self._states.append(State(count, False, _now(self._top)))
        self._states += [State(count, True, tree) for tree in _possible(self._top)]
        if self.kill_after is not None and count >= self.kill_after and call != "begin":
            raise Killed

    def _find(self, path: str | os.PathLike[str]) -> tuple[_Folder, str] | None:
        """The folder that holds a path, and the name there; None for a path elsewhere."""
        place = Path.cwd() / path
        if not place.is_relative_to(self.root) or place == self.root:
            return None
        *above, name = place.relative_to(self.root).parts
        folder = self._top
        for part in above:
            folder = folder.now[part]
        return folder, name

    def _node(self, path: str | os.PathLike[str]) -> Any:
        if Path.cwd() / path == self.root:
            return self._top
        found = self._find(path)
        return found[0].now.get(found[1]) if found is not None else None

    @contextmanager
    def recorded(self, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
        """Take part in the calls of `os` for the time of the context. `open` and `Path.write_bytes` are not seen."""
        real = {name: getattr(os, name) for name in _CALLS}

        def change(folder: _Folder, call: str, **names: Any) -> None:
            now = {**folder.now, **names}
            folder.changes.append({name: node for name, node in now.items() if node is not None})
            self._note(call)

        def on_open(path: Any, flags: int, mode: int = 0o777, **more: Any) -> int:
            there = self._node(path)
            file: int = real["open"](path, flags, mode, **more)
            found = self._find(path)
            if there is None and found is not None:
                there = _Inode()
                self._open[file] = there
                change(found[0], f"create {found[1]}", **{found[1]: there})
            elif there is not None:
                self._open[file] = there
                if flags & os.O_TRUNC and there.now:
                    there.now = b""
                    self._note(f"truncate {path}")
            return file

        def on_close(file: int) -> None:
            self._open.pop(file, None)
            real["close"](file)

        def store(file: int, data: bytes, at: int, call: str) -> None:
            if (node := self._open.get(file)) is not None and data:
                node.now = node.now[:at].ljust(at, b"\0") + data + node.now[at + len(data) :]
                self._note(call)

        def on_write(file: int, data: Any) -> int:
            at = os.lseek(file, 0, os.SEEK_CUR)
            count: int = real["write"](file, data)
            store(file, bytes(data)[:count], at, "write")
            return count

        def on_pwrite(file: int, data: Any, at: int) -> int:
            count: int = real["pwrite"](file, data, at)
            store(file, bytes(data)[:count], at, "pwrite")
            return count

        def on_fallocate(file: int, at: int, size: int) -> None:
            real["posix_fallocate"](file, at, size)
            node = self._open.get(file)
            if node is not None and len(node.now) < at + size:
                node.now = node.now.ljust(at + size, b"\0")
                self._note("posix_fallocate")

        def on_truncate(file: int, size: int) -> None:
            real["ftruncate"](file, size)
            node = self._open.get(file)
            if node is not None and len(node.now) != size:
                node.now = node.now[:size].ljust(size, b"\0")
                self._note("ftruncate")

        def sync(name: str) -> Any:
            def on_sync(file: int) -> None:
                real[name](file)
                node = self._open.get(file)
                if isinstance(node, _Folder):
                    node.synced, node.changes = node.now, []
                elif node is not None:
                    node.synced = node.now
                if node is not None:
                    self._note(name)

            return on_sync

        def on_sync_all() -> None:  # the real one would wait for all that others write on this machine
            _sync(self._top)
            self._note("sync")

        def on_symlink(target: Any, path: Any, *more: Any, **named: Any) -> None:
            real["symlink"](target, path, *more, **named)
            if (found := self._find(path)) is not None:
                change(found[0], f"symlink {found[1]}", **{found[1]: Link(os.fspath(target))})

        def move(name: str) -> Any:
            def on_move(old: Any, new: Any) -> None:
                real[name](old, new)
                source, target = self._find(old), self._find(new)
                if source is not None and target is not None:
                    assert source[0] is target[0], "moved between folders"
                    change(source[0], name, **{source[1]: None, target[1]: source[0].now[source[1]]})

            return on_move

        def on_unlink(path: Any, **more: Any) -> None:
            real["unlink"](path, **more)
            if (found := self._find(path)) is not None:
                change(found[0], f"unlink {found[1]}", **{found[1]: None})

        def on_mkdir(path: Any, mode: int = 0o777, **more: Any) -> None:
            real["mkdir"](path, mode, **more)
            if (found := self._find(path)) is not None:
                change(found[0], f"mkdir {found[1]}", **{found[1]: _Folder()})

        doubles = {
            "open": on_open,
            "close": on_close,
            "write": on_write,
            "pwrite": on_pwrite,
            "posix_fallocate": on_fallocate,
            "ftruncate": on_truncate,
            "fsync": sync("fsync"),
            "fdatasync": sync("fdatasync"),
            "sync": on_sync_all,
            "symlink": on_symlink,
            "replace": move("replace"),
            "rename": move("rename"),
            "unlink": on_unlink,
            "mkdir": on_mkdir,
        }
        with monkeypatch.context() as patch:
            for name, double in doubles.items():
                patch.setattr(os, name, double)
            yield


_CALLS = (
    "open", "close", "write", "pwrite", "posix_fallocate", "ftruncate", "fsync", "fdatasync", "sync", "symlink",
    "replace", "rename", "unlink", "mkdir",
)  # fmt: skip


def _now(node: Any) -> Any:
    if isinstance(node, Link):
        return node
    if isinstance(node, _Folder):
        return {name: _now(each) for name, each in node.now.items()}
    return node.now


def _sync(node: Any) -> None:
    if isinstance(node, _Folder):
        node.synced, node.changes = node.now, []
        for each in node.synced.values():
            _sync(each)
    elif isinstance(node, _Inode):
        node.synced = node.now


def _possible(node: Any) -> list[Any]:
    if isinstance(node, Link):
        return [node]
    if isinstance(node, _Inode):
        return list(node.contents())
    trees = []
    for names in (node.synced, *node.changes):
        inside = [_possible(each) for each in names.values()]
        trees += [dict(zip(names, chosen, strict=True)) for chosen in product(*inside)]
    return trees
