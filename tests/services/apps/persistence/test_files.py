"""What the app host keeps in files: lock and incarnation, snapshot."""

import errno
import os
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.apps.persistence import claim
from services.apps.persistence.claim import AppLock
from services.apps.persistence.snapshot import MAX_SNAPSHOT, SnapshotFile
from swarm.errors import AppError, LocalError

# Lock and incarnation


def test_one_process_at_a_time_and_a_number_that_goes_up(tmp_path: Path) -> None:
    first = AppLock(tmp_path, "consensus", tmp_path / "state")
    with pytest.raises(LocalError, match=r"app\.consensus\.lock: another process runs app consensus on this robot"):
        AppLock(tmp_path, "consensus", tmp_path / "state")
    other = AppLock(tmp_path, "other", tmp_path / "state")
    first.close()
    second = AppLock(tmp_path, "consensus", tmp_path / "state")
    assert (first.incarnation, second.incarnation, other.incarnation) == (1, 2, 1)
    second.close()
    other.close()


def test_a_runtime_directory_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(LocalError, match=r"none/app\.consensus\.lock: No such file or directory"):
        AppLock(tmp_path / "none", "consensus", tmp_path / "state")


def test_a_damaged_incarnation_is_not_guessed(tmp_path: Path) -> None:
    (tmp_path / "app.consensus.lock").write_text("what is this")
    with pytest.raises(LocalError, match="cannot be used"):
        AppLock(tmp_path, "consensus", tmp_path / "state")


def incarnation_after_boot(tmp_path: Path) -> int:
    """Of a process that starts when the runtime directory was cleared."""
    (tmp_path / "app.consensus.lock").unlink(missing_ok=True)
    lock = AppLock(tmp_path, "consensus", tmp_path / "state")
    lock.close()
    return lock.incarnation


def test_the_incarnation_goes_up_though_a_boot_has_taken_the_lock_file(tmp_path: Path) -> None:
    """Neighbours that ran on ignore everything of a lower one."""
    for _ in range(3):
        AppLock(tmp_path, "consensus", tmp_path / "state").close()
    assert incarnation_after_boot(tmp_path) == 4
    assert incarnation_after_boot(tmp_path) == 5


@pytest.mark.parametrize("damage", [b"", b"what is this", b"9" * 1000, bytes(20), "x".encode("utf-16")])
def test_a_kept_incarnation_that_is_damaged_is_replaced_by_a_greater_one(tmp_path: Path, damage: bytes) -> None:
    assert incarnation_after_boot(tmp_path) == 1
    (tmp_path / "state/epochs/consensus.starts").write_bytes(damage)
    found = incarnation_after_boot(tmp_path)
    assert found > 1_000_000_000
    assert incarnation_after_boot(tmp_path) > found


def test_an_app_starts_where_its_incarnation_cannot_be_kept(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    (tmp_path / "state").write_text("no folder")
    assert incarnation_after_boot(tmp_path) >= 1
    assert "neighbours may ignore this app" in caplog.text


def test_the_incarnation_goes_up_through_a_reboot_on_a_full_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def full(path: Path, data: bytes) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    assert incarnation_after_boot(tmp_path) == 1
    monkeypatch.setattr(claim, "atomic_write", full)
    assert [incarnation_after_boot(tmp_path) for _ in range(2)] == [2, 3]
    assert caplog.text == ""


# Snapshot


@given(st.lists(st.binary(max_size=300), max_size=9), st.integers(2, 5))
def test_the_newest_snapshots_are_read(
    tmp_path_factory: pytest.TempPathFactory, written: list[bytes], slots: int
) -> None:
    path = tmp_path_factory.mktemp("s") / "app.x.snapshot"
    file = SnapshotFile(path, slots)
    for data in written:
        file.write(data)
    file.close()
    file = SnapshotFile(path, slots)
    assert file.read() == written[-slots:]
    file.write(b"next")
    file.close()
    file = SnapshotFile(path, slots)
    assert file.read() == [*written, b"next"][-slots:]
    file.close()


@given(st.integers(0, 200), st.binary(min_size=1, max_size=64))
def test_a_torn_write_leaves_the_one_before(tmp_path_factory: pytest.TempPathFactory, at: int, garbage: bytes) -> None:
    """Whatever part of the newest slot is wrong, the older one counts."""
    path = tmp_path_factory.mktemp("s") / "app.x.snapshot"
    file = SnapshotFile(path)
    file.write(b"one" * 60)
    file.write(b"two" * 60)  # in the first slot
    file.close()
    whole = path.read_bytes()
    torn = whole[:at] + garbage + whole[at + len(garbage) :]
    path.write_bytes(torn)
    file = SnapshotFile(path)
    expected = b"two" * 60 if torn[:204] == whole[:204] else b"one" * 60
    assert file.read()[-1] == expected
    file.close()


def test_a_snapshot_has_a_largest_size(tmp_path: Path) -> None:
    file = SnapshotFile(tmp_path / "app.x.snapshot")
    file.write(bytes(MAX_SNAPSHOT))
    with pytest.raises(AppError, match=r"a snapshot of \d+ bytes, at most \d+ can be kept"):
        file.write(bytes(MAX_SNAPSHOT + 1))
    assert file.read() == [bytes(MAX_SNAPSHOT)]
    file.close()


def test_a_disk_without_space_is_found_at_the_start(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "posix_fallocate", full)
    with pytest.raises(LocalError, match=r"app\.x\.snapshot: cannot have its 131072 bytes: No space left"):
        SnapshotFile(tmp_path / "app.x.snapshot")
