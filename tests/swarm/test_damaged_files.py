"""What a restart makes of each file that the process before, or a power cut, has left damaged
(docs/reference/robot/services.md has the table). The votes are in tests/services/apps/persistence/test_ballots.py,
recordings in tests/swarm/recording, the installed release in tests/deploy/test_install_cut.py."""

import logging
import os
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import pytest
from conftest import wait_until

from laptop.fleet.files.journal import JournalMark
from services.apps.host import topology
from services.apps.host.changes import Changes
from services.apps.persistence import run_file
from services.apps.persistence.claim import AppLock
from services.apps.persistence.snapshot import SnapshotFile
from services.balancer.core.control.estimation.gyro import Zero
from services.balancer.zero_file import ZeroFile
from services.dwm.localizer import load_calibration
from services.mesh import file_writer, stops_file, topology_file
from services.mesh.core.overlays.stop import Halt, Mark, to_file
from services.mesh.core.routing.topology import Ground
from swarm.config import load
from swarm.config.keyfile import new_key_file, read_keys
from swarm.errors import LocalError, SwarmError
from swarm.messages.codec import encode
from swarm.recording import folder
from swarm.recording.journal import NO_OWNER, Journal

REFUSED = "refused, with the file's name"
CONFIG = """network = "test"
[topology]
edges = [["r0", "r1"]]
[mesh]
insecure = true
[[robots]]
name = "r0"
link = "tcp:127.0.0.1:7001"
[[robots]]
name = "r1"
link = "tcp:127.0.0.1:7002"
"""


class Kept(NamedTuple):
    """A file: how it is written, how it is read, and what a damaged one means."""

    name: str
    write: Callable[[Path], object]
    read: Callable[[Path], object]
    means: object


def read_links(place: Path) -> object:
    kept = run_file.read(topology._Kept, place, 7, "the links in force hold")
    return None if kept is None else kept.edges


def write_topology(place: Path) -> None:
    ground = Ground(("r0", "r1"), (("r0", "r1"),), auto=False)
    file_writer.save(place, ground.to_file(ground.first))


def read_topology(place: Path) -> object:
    return topology_file.load(place.parent, Ground(("r0", "r1"), (("r0", "r1"),), auto=False))


def read_stops(place: Path) -> object:
    halt = stops_file.load(place.parent, "r0", 7)
    return None if halt is None else [(name, mark) for name, (mark, _) in halt.stops.items()]


def read_claim(place: Path) -> int:
    claim = AppLock(place.parent, "x", place.parent)
    claim.close()
    return claim.incarnation


def write_snapshot(place: Path) -> None:
    file = SnapshotFile(place)
    file.write(b"state")
    file.close()


def read_snapshot(place: Path) -> list[bytes]:
    file = SnapshotFile(place)
    try:
        return file.read()
    finally:
        file.close()


def write_journal(place: Path) -> None:
    journal = Journal(place)
    journal.begin(0, NO_OWNER)
    journal.add(b"record")
    journal.close()


def read_journal(place: Path) -> list[tuple[int, bytes]]:
    journal = Journal(place)
    try:
        return journal.left(NO_OWNER)
    finally:
        journal.close()


def read_parameters(place: Path) -> object:
    changes: Any = Changes.__new__(Changes)
    changes._path, changes._run = place, 7
    return changes._read()


KEPT = [
    Kept("swarm.toml", lambda place: place.write_text(CONFIG), load, REFUSED),
    Kept("key", lambda place: new_key_file(place, 1e9), read_keys, REFUSED),
    Kept("topology", write_topology, read_topology, None),
    Kept(
        stops_file.NAME,
        lambda place: file_writer.save(place, to_file(Halt({"r0": (Mark(5, 1), "smoke")}, {"r1": Mark(4, 1)}))),
        read_stops,
        [("r0", Mark(7, 1))],  # a stop of this start: the file may have held one
    ),
    Kept("app.x.lock", read_claim, read_claim, REFUSED),
    Kept("app.x.snapshot", write_snapshot, read_snapshot, []),
    Kept("app.x.journal", write_journal, read_journal, []),
    Kept(
        "app.x.topology",
        lambda place: place.write_bytes(encode(topology._Kept(7, (("r0", "r1"),)))),
        read_links,
        None,
    ),
    Kept(
        "app.x.parameters",
        lambda place: place.write_bytes(encode({"run": 7, "parameters": {"gain": 2.0}})),
        read_parameters,
        {},
    ),
    Kept(
        "balancer.zero",
        lambda place: ZeroFile(place.parent).keep(Zero(0.1, 0.1, 0.1), 10.0),
        lambda place: ZeroFile(place.parent).read(11.0),
        None,
    ),
    Kept(
        folder.RUN_FILE,
        lambda place: folder.begin(place.parent, {"app": "x", "run": "1"}, {}),
        lambda place: folder.read_run(place.parent),
        REFUSED,
    ),
    Kept(
        folder.OUTCOME_FILE,
        lambda place: folder.keep_outcome(place.parent, {"problems": "[]"}),
        lambda place: folder.read_outcome(place.parent),
        REFUSED,
    ),
    Kept(
        "r0.mark",
        lambda place: place.write_text(JournalMark(10, "s=abc").text),
        lambda p: JournalMark.of(p.read_text(errors="replace")),
        JournalMark(),
    ),
]
UNSEEN = {
    ("app.x.lock", "empty"),  # as at the first start
    (folder.RUN_FILE, "empty"),
    (folder.RUN_FILE, "cut short"),  # a text of whole lines says nothing of those that are missing
    ("swarm.toml", "cut short"),
}
"""Damage that cannot be seen in the file itself."""

OF_PEOPLE = ("swarm.toml", folder.RUN_FILE, folder.OUTCOME_FILE, "r0.mark")
"""Files that people write, or that only a laptop reads."""

GARBAGE = b"\xffgarbage\x00\xfe = [" * 40


@pytest.mark.parametrize("kept", KEPT, ids=[kept.name for kept in KEPT])
@pytest.mark.parametrize("damage", ["garbage", "cut short", "empty", "zeros"])
def test_a_damaged_file_means_what_the_table_says(kept: Kept, damage: str, tmp_path: Path) -> None:
    place = tmp_path / kept.name
    kept.write(place)
    whole = kept.read(place)
    assert whole != kept.means
    data = place.read_bytes()
    place.write_bytes(
        {
            "garbage": GARBAGE,
            "cut short": data[: len(data.rstrip(b"\0\n ")) // 2],
            "empty": b"",
            "zeros": bytes(len(data)),
        }[damage]
    )
    found, error = outcome(kept, place)
    if error or (kept.means == REFUSED and (kept.name, damage) not in UNSEEN):
        assert kept.means == REFUSED
        assert str(place) in error
    elif kept.means != REFUSED:
        assert found == kept.means  # nothing is guessed: a part of the file is not taken for all of it


@pytest.mark.parametrize("kept", [kept for kept in KEPT if kept.name not in OF_PEOPLE], ids=lambda kept: kept.name)
def test_a_file_that_has_grown_beyond_the_memory_keeps_no_service_from_its_start(kept: Kept, tmp_path: Path) -> None:
    """The kernel ends a service at its limit of memory, 48 MB and more, at each of its starts."""
    place = tmp_path / kept.name
    kept.write(place)
    os.truncate(place, 1 << 30)
    tracemalloc.start()
    try:
        outcome(kept, place)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < 8 << 20


def outcome(kept: Kept, place: Path) -> tuple[object, str]:
    """What is read, or else the error's text."""
    try:
        return kept.read(place), ""
    except (SwarmError, OSError, UnicodeDecodeError) as error:
        return None, str(error)


@pytest.mark.parametrize("kept", KEPT, ids=[kept.name for kept in KEPT])
def test_a_file_that_may_not_be_read_is_refused_or_counts_as_damaged(
    kept: Kept, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As one of another user: root, who runs tests, may read everything, so the calls are doubles."""
    place = tmp_path / kept.name
    kept.write(place)
    real_open, real_os_open = Path.open, os.open

    def refuse(*arguments: Any, **more: Any) -> Any:
        if Path(arguments[0]) == place:
            raise PermissionError(13, "Permission denied", str(place))
        return (real_os_open if isinstance(arguments[1] if len(arguments) > 1 else "", int) else real_open)(
            *arguments, **more
        )

    monkeypatch.setattr(Path, "open", refuse)
    monkeypatch.setattr("io.open", refuse)
    monkeypatch.setattr(os, "open", refuse)
    found, error = outcome(kept, place)
    assert str(place) in error if error else found == kept.means


def test_a_calibration_that_is_damaged_is_refused_with_its_name(tmp_path: Path) -> None:
    path = tmp_path / "r0.toml"
    linear = SimpleNamespace(gain=1.0, offset=0.0)
    config: Any = SimpleNamespace(
        dwm=SimpleNamespace(calibration="{robot}.toml", distance=linear, position=None),
        path=tmp_path / "swarm.toml",
        anchors=(),
    )
    for data in (b"", GARBAGE, b"robot = "):
        path.write_bytes(data)
        with pytest.raises(LocalError, match=r"r0\.toml"):
            load_calibration(config, "r0")


def test_a_mesh_that_cannot_keep_a_stop_for_its_restart_says_so_until_there_is_room(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It did not try again, so a mesh that was restarted later knew of no stop; and it said so for ever."""
    monkeypatch.setattr(file_writer, "PAUSE_S", 0.01)
    place = tmp_path / "mesh"
    place.write_text("a file where the folder is to be")
    file = file_writer.FileWriter("stops", place / stops_file.NAME)
    file.keep(b"older")
    file.keep(b"data")
    wait_until(lambda: file.problem.startswith(f"stops cannot be kept through a restart: {place}: "))
    place.unlink()
    wait_until(lambda: not file.problem)
    assert (place / stops_file.NAME).read_bytes() == b"data"
    file.close()


def test_the_content_given_last_before_the_end_is_in_the_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(file_writer, "_END_S", 60.0)
    file = file_writer.FileWriter("stops", tmp_path / stops_file.NAME)
    for number in range(100):
        file.keep(b"%d" % number)
    file.close()
    assert (tmp_path / stops_file.NAME).read_bytes() == b"99"


def test_news_in_a_loop_are_written_now_and_at_the_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each write wears the card."""
    monkeypatch.setattr(file_writer, "_END_S", 60.0)
    monkeypatch.setattr(file_writer, "PAUSE_S", 60.0)
    written: list[bytes] = []
    monkeypatch.setattr(file_writer, "save", lambda path, data: written.append(data))
    file = file_writer.FileWriter("stops", tmp_path / stops_file.NAME)
    file.keep(b"first")
    wait_until(lambda: written == [b"first"])
    for number in range(100):
        file.keep(b"%d" % number)
    file.close()
    assert written == [b"first", b"99"]


def test_what_a_run_s_own_files_lack_is_said_in_the_log(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    for name, read in (("app.x.topology", read_links), ("app.x.parameters", read_parameters)):
        caplog.clear()
        place = tmp_path / name
        assert not read(place)
        assert not caplog.records  # there was none
        place.write_bytes(GARBAGE)
        with caplog.at_level(logging.WARNING):
            assert not read(place)
        assert name in caplog.text
