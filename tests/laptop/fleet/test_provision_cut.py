"""A power cut leaves what `swarm provision` and `swarm pair` change whole, and takes nothing of it when they are done.

The programs that run on a robot run here, below a folder that stands for its root, on the double of the disk
(`power_cut`). What a command or bluetoothd writes is not synced by them, as on a robot.
"""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock

import pytest
from power_cut import Disk, Link, State

from laptop.cli.robots import pair
from swarm.config import parse
from swarm.errors import LocalError
from swarm.onboard.bootstrap import changes, pairing
from swarm.onboard.bootstrap.bluez import BluezError

PEER = "B8:27:EB:00:00:11"
OLD, NEW = b"127.0.0.1 localhost\n", b"127.0.0.1 localhost\n127.0.1.1 r0\n"


def write(path: Path, data: bytes) -> None:
    """As a program does that does not think of the power."""
    file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    os.write(file, data)
    os.close(file)


def at(state: State, *names: str) -> Any:
    """What is found at a place; None where there is nothing."""
    found: Any = state.tree
    for name in names:
        found = found.get(name) if isinstance(found, dict) else None
    return found


def last(disk: Disk) -> list[State]:
    """How the disk may be found once the program has said that it is done."""
    return list(disk.states(len(disk.calls)))


# -- swarm provision


def provisioned(monkeypatch: pytest.MonkeyPatch, disk: Disk, code: int = 0) -> dict[str, Any]:
    """Carry out one change of each kind; the command leaves a file behind and ends with `code`."""

    def run(*words: str, seconds: float) -> tuple[int, str, str]:
        write(disk.root / "etc/hostname", b"r0\n")
        return code, "", ""

    steps: list[Any] = [
        ("name", [{"do": "write", "path": "/etc/hosts", "text": NEW.decode(), "mode": "0644"}]),
        ("radio", [{"do": "link", "path": "/lib/firmware/brcm/a.hcd", "to": "../synaptics/a.hcd"}]),
        ("network", [{"do": "write", "path": "/etc/NetworkManager/wifi", "text": "psk=x\n", "mode": "0600"}]),
        ("name", [{"do": "run", "words": ["hostnamectl", "set-hostname", "r0"]}]),
    ]
    monkeypatch.setattr(changes, "run", run)
    with disk.recorded(monkeypatch):
        return changes.main({"root": str(disk.root), "steps": steps}, lambda _: None)


@pytest.fixture
def disk(tmp_path: Path) -> Disk:
    root = tmp_path / "root"
    (root / "etc").mkdir(parents=True)
    (root / "etc/hosts").write_bytes(OLD)
    return Disk(root)


def test_each_change_of_provision_is_whole_or_not_there(disk: Disk, monkeypatch: pytest.MonkeyPatch) -> None:
    assert provisioned(monkeypatch, disk) == {"step": "", "problem": ""}
    for state in disk.states():
        assert at(state, "etc", "hosts") in (OLD, NEW), state
        assert at(state, "lib", "firmware", "brcm", "a.hcd") in (None, Link("../synaptics/a.hcd")), state
        assert at(state, "etc", "NetworkManager", "wifi") in (None, b"psk=x\n"), state


@pytest.mark.parametrize("code", [0, 1], ids=["all done", "the command fails"])
def test_when_provision_answers_all_it_has_done_is_on_the_disk(
    disk: Disk, monkeypatch: pytest.MonkeyPatch, code: int
) -> None:
    assert bool(provisioned(monkeypatch, disk, code)["problem"]) == bool(code)
    for state in last(disk):
        assert at(state, "etc", "hosts") == NEW, state
        assert at(state, "etc", "hostname") == b"r0\n", state
        assert at(state, "etc", "NetworkManager", "wifi") == b"psk=x\n", state
        assert at(state, "lib", "firmware", "brcm", "a.hcd") == Link("../synaptics/a.hcd"), state


# -- swarm pair, on a robot


def bluetoothd(folder: Path) -> Callable[[str | None], Any]:
    """A stand-in for `Bluez` whose bluetoothd keeps each device in a file that it never syncs. What it was told it
    writes when it is idle, so before it answers the next question."""

    class Double:
        def __init__(self, adapter: str | None) -> None:
            self._idle: list[Callable[[], None]] = []

        def state(self) -> dict[str, Any]:
            self._write()
            return {"Address": "B8:27:EB:00:00:10", "Powered": True}

        def devices(self) -> list[dict[str, Any]]:
            self._write()
            there = (folder / PEER).read_bytes() if (folder / PEER).exists() else None
            return [] if there is None else [{"Address": PEER, "Paired": True, "Trusted": b"Trusted=true" in there}]

        def device(self, address: str) -> dict[str, Any] | None:
            return next(iter(self.devices()), None)

        def pair(self, address: str, seconds: float) -> None:
            self._idle.append(lambda: write(folder / PEER, b"Key=1\n"))

        def trust(self, address: str) -> None:
            if self.device(address) is None:
                raise BluezError("unknown", address)
            self._idle.append(lambda: write(folder / PEER, b"Key=1\nTrusted=true\n"))

        def forget(self, address: str) -> None:
            self._idle.append((folder / PEER).unlink)

        def wait(self, done: Callable[[], bool], seconds: float, stop: int | None = None) -> bool:
            if stop is not None:  # the other side calls
                self._idle.append(lambda: write(folder / PEER, b"Key=1\n"))
            return True

        def close(self) -> None:
            self._idle.clear()

        def __getattr__(self, name: str) -> Any:
            return lambda *_: None  # be_agent, set_adapter, inquire, stop_inquiry

        def _write(self) -> None:
            for each in self._idle:
                each()
            self._idle.clear()

    return Double


@pytest.mark.parametrize(
    ("do", "before", "after"),
    [
        ("call", None, b"Key=1\nTrusted=true\n"),
        ("listen", None, b"Key=1\nTrusted=true\n"),
        ("trust", b"Key=1\n", b"Key=1\nTrusted=true\n"),
        ("forget", b"Key=1\n", None),
    ],
)
def test_when_pairing_answers_the_key_is_on_the_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, do: str, before: bytes | None, after: bytes | None
) -> None:
    folder = tmp_path / "bluetooth"
    folder.mkdir()
    if before is not None:
        (folder / PEER).write_bytes(before)
    disk = Disk(folder)
    monkeypatch.setattr(pairing, "Bluez", bluetoothd(folder))
    with Path("/dev/null").open() as nothing:
        monkeypatch.setattr("sys.stdin", nothing)
        with disk.recorded(monkeypatch):
            answer = pairing.main({"do": do, "peer": PEER, "inquiry": 1.0}, lambda _: None)
    assert answer["problem"] == ""
    assert {at(state, PEER) for state in last(disk)} == {after}


def test_a_look_does_not_wait_for_the_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    disk = Disk(tmp_path / "bluetooth")
    monkeypatch.setattr(pairing, "Bluez", bluetoothd(disk.root))
    with disk.recorded(monkeypatch):
        assert pairing.main({"do": "look"}, lambda _: None)["problem"] == ""
    assert disk.calls == []


# -- swarm pair, on the laptop

CONFIG = 'network = "test"\n[[robots]]\nname = "r0"\n[[robots]]\nname = "r1"\n[topology]\nshape = "line"\n'


def test_the_addresses_for_a_file_that_cannot_be_written_are_shown(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "swarm.toml"
    path.write_text(CONFIG)
    monkeypatch.setattr(os, "fsync", MagicMock(side_effect=OSError(28, "No space left on device")))
    config = parse(CONFIG, path, addressed=False)
    with pytest.raises(LocalError, match=f"No space left on device; write into it yourself:\n  r1: .*{PEER}"):
        pair._complete(config, {"r1": PEER}, quiet=True)
    assert path.read_text() == CONFIG


def test_the_addresses_that_pair_finds_are_written_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "laptop" / "swarm.toml"
    path.parent.mkdir()
    path.write_text(CONFIG)
    disk = Disk(path.parent)
    config = parse(CONFIG, path, addressed=False)
    with disk.recorded(monkeypatch):
        pair._complete(config, {"r0": "B8:27:EB:00:00:10", "r1": PEER}, quiet=True)
    for state in disk.states():
        assert at(state, "swarm.toml") in (CONFIG.encode(), path.read_bytes()), state
    for state in last(disk):
        assert at(state, "swarm.toml") == path.read_bytes() != CONFIG.encode(), state
