"""The serial line between the simulated ATmega and the world's module: a pseudo-terminal that comes and goes."""

import os
import select
import tty
from pathlib import Path

import pytest

from services.dwm.core.module.tlv import LOC_GET, AnchorRange, Location, Position, encode_location
from sim.core.module_line import TTY, ModuleLine
from sim.devices.wiring import RETRY_S, ModuleWire

ANSWER = encode_location(Location(Position(1.0, 2.0, 0.0, 80), (AnchorRange("C933", 1.5, 90, Position(0, 0, 0, 100)),)))


class Module:
    """The other end of the terminal."""

    def __init__(self, path: Path) -> None:
        self.near, self.far = os.openpty()
        tty.setraw(self.far)
        path.unlink(missing_ok=True)
        path.symlink_to(os.ttyname(self.far))

    def read(self) -> bytes:
        assert select.select([self.near], [], [], 5)[0], "nothing came"
        return os.read(self.near, 100)

    def unplug(self) -> None:
        os.close(self.near)
        os.close(self.far)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / TTY


def polled(wire: ModuleWire, line: ModuleLine, now: float) -> float:
    """Goes on until the next request has left."""
    for _ in range(200):
        now += 0.002
        line.handle_timer(now)
        wire.carry(now)
        if line._line == "poll" and line._since == now:
            return now
    raise AssertionError("no poll")


def sequence(line: ModuleLine, now: float) -> int:
    return int.from_bytes(line.reporting(now)()[:2], "little")


def test_requests_go_out_and_answers_come_in(path: Path) -> None:
    module, line = Module(path), ModuleLine(10.0)
    wire = ModuleWire(lambda: line, path)
    now = polled(wire, line, 10.0)
    assert module.read() == LOC_GET.request
    os.write(module.near, ANSWER)
    assert select.select([wire._terminal], [], [], 5)[0]
    wire.carry(now + 0.02)
    assert sequence(line, now + 0.02) == 1
    module.unplug()


def test_a_module_that_comes_late_is_found_and_one_that_goes_is_looked_for(path: Path) -> None:
    line = ModuleLine(10.0)
    wire = ModuleWire(lambda: line, path)
    now = polled(wire, line, 10.0)  # into nothing, as on a wire
    first = Module(path)
    now = polled(wire, line, now + RETRY_S)
    assert first.read() == LOC_GET.request
    first.unplug()
    now = polled(wire, line, now)
    assert wire._terminal is None
    second = Module(path)
    now = polled(wire, line, now + RETRY_S)
    assert second.read() == LOC_GET.request
    second.unplug()


def test_after_a_reset_the_atmega_speaks_again(path: Path) -> None:
    module = Module(path)
    lines = [ModuleLine(10.0)]
    wire = ModuleWire(lambda: lines[-1], path)
    now = polled(wire, lines[-1], 10.0)
    assert module.read() == LOC_GET.request
    lines.append(ModuleLine(now))
    now = polled(wire, lines[-1], now)
    assert module.read() == LOC_GET.request
    module.unplug()
