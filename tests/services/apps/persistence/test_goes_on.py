"""Which file of an earlier process the recording of an app goes on with: one of the same run. What cannot be read is
never overwritten."""

from collections import Counter
from pathlib import Path

import pytest

from services.apps.persistence import recording
from services.apps.persistence.recording import _goes_on
from swarm.recording.file import RecordingFile
from swarm.recording.reader import RUN


def recorded(path: Path, run: str) -> bytes:
    file = RecordingFile(path, Counter(), append=False, min_free=0)
    file.metadata(RUN, {"run": run})
    for i in range(100):
        file.write("swarm/r0/app/x/state", float(i), {"i": i})
    file.close()
    return path.read_bytes()


def aside(path: Path) -> list[bytes]:
    return [each.read_bytes() for each in sorted(path.parent.glob("*.damaged*"))]


def test_a_file_of_the_same_run_is_gone_on_with_and_no_other(tmp_path: Path) -> None:
    path = tmp_path / "r0.x.mcap"
    assert not _goes_on(path, "7")
    recorded(path, "7")
    assert _goes_on(path, "7")
    assert not _goes_on(path, "8")
    path.write_bytes(b"")
    assert not _goes_on(path, "7")
    assert aside(path) == []


def test_a_file_whose_beginning_is_damaged_is_set_aside_with_all_that_it_has(tmp_path: Path) -> None:
    path = tmp_path / "r0.x.mcap"
    damaged = []
    for count in range(2):
        data = bytes(8) + recorded(path, "7")[8:]
        path.write_bytes(data + bytes(count))
        damaged.append(data + bytes(count))
        assert not _goes_on(path, "7")
        assert not path.exists()
    assert aside(path) == damaged


def test_a_file_that_a_disk_cannot_read_does_not_keep_the_app_from_its_start(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "r0.x.mcap"
    whole = recorded(path, "7")

    def fail(_: Path) -> str:
        raise OSError(5, "Input/output error")

    monkeypatch.setattr(recording, "run_of", fail)
    assert not _goes_on(path, "7")
    assert aside(path) == [whole]


def test_a_damaged_file_that_cannot_be_set_aside_is_not_begun_anew(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "r0.mcap"
    path.write_bytes(b"damaged" * 100)

    def fails(*_: object) -> None:
        raise OSError("Read-only file system")

    monkeypatch.setattr(recording, "set_aside", fails)
    assert _goes_on(path, "7")
