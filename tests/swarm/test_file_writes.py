"""Files are whole after a kill, a power cut at any call, and on a full disk."""

import errno
import os
import stat
from pathlib import Path

import pytest
from conftest import examples, open_files
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from power_cut import Disk, Killed

from swarm.files import atomic_write, make_folder, open_reserved


def content(path: Path) -> bytes | None:
    return path.read_bytes() if path.exists() else None


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=examples(30), deadline=None)
@given(old=st.none() | st.binary(max_size=40), new=st.binary(min_size=1, max_size=40))
def test_after_a_cut_at_any_call_a_file_is_whole_and_after_the_last_call_new(
    tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch, old: bytes | None, new: bytes
) -> None:
    root, found = tmp_path_factory.mktemp("disk"), tmp_path_factory.mktemp("found") / "it"
    if old is not None:
        (root / "file").write_bytes(old)
    disk = Disk(root)
    with disk.recorded(monkeypatch):
        atomic_write(root / "file", new)
    for state in disk.states():
        seen = content(state.lay_out(found) / "file")
        assert seen in (old, new), state
        if state.calls == len(disk.calls):
            assert seen == new, state


def test_a_write_to_a_symbolic_link_changes_the_file_that_it_leads_to(tmp_path: Path) -> None:
    """People keep their swarm.toml elsewhere, and a robot's /etc/swarm leads to the settings of its release."""
    (tmp_path / "kept").mkdir()
    target, link = tmp_path / "kept/swarm.toml", tmp_path / "swarm.toml"
    target.write_bytes(b"old")
    target.chmod(0o640)
    link.symlink_to("kept/swarm.toml")
    atomic_write(link, b"new")
    assert link.is_symlink()
    assert target.read_bytes() == b"new"
    assert target.stat().st_mode & 0o777 == 0o640
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["kept", "swarm.toml", "swarm.toml"]
    target.unlink()
    atomic_write(link, b"again")
    assert (link.is_symlink(), target.read_bytes()) == (True, b"again")


def test_the_double_finds_a_missing_sync_of_the_file_and_of_the_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The double itself is tested: a writer that forgets one of the two syncs is caught."""
    for forgotten in ("file", "folder"):
        root = tmp_path / forgotten
        root.mkdir()
        (root / "file").write_bytes(b"old content")
        disk = Disk(root)
        real = os.fsync

        def fsync(file: int, forgotten: str = forgotten, real: object = real) -> None:
            folder = stat.S_ISDIR(os.fstat(file).st_mode)
            if folder != (forgotten == "folder"):
                os.fdatasync(file)

        with disk.recorded(monkeypatch), monkeypatch.context() as patch:
            patch.setattr(os, "fsync", fsync)
            atomic_write(root / "file", b"new content")
        seen = {content(state.lay_out(tmp_path / "found") / "file") for state in disk.states(len(disk.calls))}
        assert seen != {b"new content"}, forgotten


def test_a_killed_writer_leaves_the_file_whole_and_the_next_one_writes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    root = tmp_path / "disk"
    for calls in range(1, 8):
        disk = Disk(root)
        atomic_write(root / "file", b"old")
        disk = Disk(root)
        disk.kill_after = calls
        with disk.recorded(monkeypatch):
            try:
                atomic_write(root / "file", b"new")
                done = True
            except Killed:
                done = False
        assert content(root / "file") in (b"old", b"new")
        atomic_write(root / "file", b"next")
        assert content(root / "file") == b"next"
        assert sorted(each.name for each in root.iterdir()) == ["file"]
        assert done == (calls > len(disk.calls))


def test_a_write_without_room_leaves_the_old_content_and_no_remains(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_bytes(b"old")
    for name in ("write", "fsync", "replace"):

        def full(*_: object) -> None:
            raise OSError(errno.ENOSPC, "No space left on device")

        with monkeypatch.context() as patch:
            patch.setattr(os, name, full)
            with pytest.raises(OSError, match="No space left"):
                atomic_write(tmp_path / "file", b"new content")
        assert content(tmp_path / "file") == b"old"
        assert [each.name for each in tmp_path.iterdir()] == ["file"]


def test_a_write_that_the_system_cuts_short_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write = os.write
    monkeypatch.setattr(os, "write", lambda file, data: write(file, data[:3]))
    atomic_write(tmp_path / "file", b"ten bytes.")
    assert content(tmp_path / "file") == b"ten bytes."


def test_a_replaced_file_keeps_its_permissions_and_a_secret_is_never_readable_to_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "file"
    atomic_write(path, b"1", mode=0o640)
    atomic_write(path, b"2")
    assert stat.S_IMODE(path.stat().st_mode) == 0o640
    modes = []
    write = os.write

    def seen(file: int, data: bytes) -> int:
        modes.append(stat.S_IMODE(os.fstat(file).st_mode))
        return write(file, data)

    monkeypatch.setattr(os, "write", seen)
    atomic_write(path, b"3", mode=0o600)
    assert modes == [0o600]


def test_a_new_file_gets_what_the_umask_leaves(tmp_path: Path) -> None:
    before = os.umask(0o027)
    try:
        atomic_write(tmp_path / "file", b"1")
    finally:
        os.umask(before)
    assert stat.S_IMODE((tmp_path / "file").stat().st_mode) == 0o640


def test_with_a_reason_nothing_waits_for_the_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    disk = Disk(tmp_path / "disk")
    with disk.recorded(monkeypatch):
        atomic_write(disk.root / "file", b"new", unsynced="a test")
    assert not [call for call in disk.calls if "sync" in call]
    for state in disk.states():
        if not state.cut:  # a kill alone leaves it whole all the same
            assert content(state.lay_out(tmp_path / "found") / "file") in (None, b"new")


def test_folders_that_were_made_are_on_the_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    disk = Disk(tmp_path / "disk")
    with disk.recorded(monkeypatch):
        make_folder(disk.root / "a" / "b")
        make_folder(disk.root / "a" / "b")
    assert all("b" in state.tree["a"] for state in disk.states(len(disk.calls)))


def test_a_reserved_file_keeps_what_it_holds(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"content")
    file = open_reserved(tmp_path / "file", 8192, 0o600)
    os.close(file)
    assert (tmp_path / "file").read_bytes() == b"content" + bytes(8192 - 7)
    assert (tmp_path / "file").stat().st_blocks * 512 >= 8192


def test_a_disk_without_room_for_a_reserved_file_is_found_when_it_is_opened(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "posix_fallocate", full)
    with pytest.raises(OSError, match="No space left"):
        open_reserved(tmp_path / "file", 8192, 0o600)
    assert str(tmp_path / "file") not in open_files(os.getpid())
