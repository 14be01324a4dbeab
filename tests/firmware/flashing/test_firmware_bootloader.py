"""Pololu's own bootloader in the simulator, with our firmware and our flashing: reset, key and flash paths.

The bootloader is not ours and is not here. `SWARM_POLOLU_BOOTLOADER` names its file, Caterina-A-Star.hex of Pololu's
repository a-star (folder bootloaders/caterina). test_firmware_board.py and test_flash.py have stand-ins of it.
"""

import os
from collections.abc import Callable
from pathlib import Path

import pytest
from avr_bench import BROWN_OUT, POWER_ON, RESET_PIN, WATCHDOG, Bench
from caterina import Caterina
from firmware_layout import CONSTANTS, FIRMWARE, RESET_CAUSE
from usb_host import UsbHost

from services.balancer.core.flashing import avr109, image
from services.balancer.core.flashing.image import Image
from services.balancer.flash.flash import START_S
from services.balancer.flash.usb_port import BOOTLOADER as IDS

pytest_plugins = ("firmware_fixtures",)

FILE = os.environ.get("SWARM_POLOLU_BOOTLOADER", "")
pytestmark = pytest.mark.skipif(not FILE, reason="SWARM_POLOLU_BOOTLOADER names no Caterina-A-Star.hex")

START, END = 0x7000, 0x8000
WARM = RESET_CAUSE["WARM"]
TIMEOUT_S = 8.0
"""After which the bootloader leaves for the program."""
ERASED = 0xFF


def bytes_of(hex_file: Path) -> dict[int, int]:
    """What an Intel HEX file puts where."""
    found = {}
    for line in hex_file.read_text().split():
        record = bytes.fromhex(line[1:])
        if record[3] == 0:
            at = int.from_bytes(record[1:3])
            found |= {at + i: byte for i, byte in enumerate(record[4 : 4 + record[0]])}
    return found


@pytest.fixture
def board(new_bench: Callable[..., Bench]) -> Bench:
    """A board with Pololu's bootloader and our firmware, switched on."""
    bench = new_bench()
    there = bytes_of(Path(FILE))
    for address in range(START, END, 2):
        bench.call("set_flash", address, there.get(address, ERASED) | there.get(address + 1, ERASED) << 8)
    bench.call("boot_at", START)
    bench.call("reset", POWER_ON)
    bench.run(0.02)
    return bench


def runs(bench: Bench) -> bool:
    """Whether our firmware runs, not the bootloader."""
    return bench.call("pc") < START


def enter(bench: Bench) -> None:
    """As `swarm flash` has the firmware start its bootloader."""
    bench.put("COMMAND", CONSTANTS["BOOTLOADER_COMMAND"].to_bytes(2, "little"))
    bench.run(0.5)
    assert not runs(bench)


def program(bench: Bench) -> bytes:
    return b"".join(bench.call("flash", at).to_bytes(2, "little") for at in range(0, START, 2))


def converse(host: UsbHost, conversation: avr109.Conversation, exchanges: int = 10**6) -> list[tuple[bytes, bytes]]:
    """Every request with its answer, until the end or until the cable is pulled."""
    said = []
    exchange = next(conversation)
    try:
        while len(said) < exchanges:
            host.write(exchange.request)
            said.append((exchange.request, host.read(exchange.answer, exchange.patience_s)))
            exchange = conversation.send(said[-1][1])
    except StopIteration:
        pass
    return said


@pytest.fixture(scope="module")
def ours() -> Image:
    return image.read((FIRMWARE / "balboa.hex").read_text())


@pytest.mark.parametrize(
    ("flags", "cause"), [(POWER_ON, WARM), (BROWN_OUT, WARM | BROWN_OUT), (0, WARM), (WATCHDOG, WARM)]
)
def test_after_each_reset_the_firmware_runs_and_tells_the_cause(board: Bench, flags: int, cause: int) -> None:
    board.call("reset", flags)
    board.run(0.02)
    assert runs(board)
    assert board.number("RESET_CAUSE") == cause


def test_one_press_of_reset_starts_the_firmware_and_two_the_bootloader(board: Bench) -> None:
    board.call("reset", RESET_PIN)
    board.run(0.7)
    assert not runs(board)
    board.run(0.1)
    assert runs(board)
    board.call("reset", RESET_PIN)
    board.run(0.5)
    board.call("reset", RESET_PIN)
    board.run(2.0)
    assert not runs(board)


def test_the_command_starts_the_bootloader_with_the_motors_off_until_its_timeout(board: Bench) -> None:
    board.drive(300, -300)
    enter(board)
    assert board.call("resets") == 1
    assert [board.call("pin_out", b"B", bit) for bit in (5, 6)] == [-1, -1], "motor pins are inputs"
    board.run(TIMEOUT_S - 1.0)
    assert not runs(board)
    board.run(1.0)
    assert runs(board)
    assert board.number("VERSION") == CONSTANTS["LAYOUT_VERSION"]


def test_the_bootloader_takes_our_firmware_over_usb_and_starts_it(board: Bench, ours: Image) -> None:
    board.call("set_flash", 0x6000, 0x1234)
    enter(board)
    host = UsbHost(board)
    assert host.ids == IDS
    said = converse(host, avr109.flash(ours, lambda _: None))
    assert program(board) == ours.data.ljust(START, bytes((ERASED,)))
    board.run_until(lambda: runs(board), START_S)
    board.run(0.02)
    assert board.number("REVISION") == ours.revision
    stand_in = Caterina()
    assert [(request, stand_in.receive(request)) for request, _ in said] == said


@pytest.mark.parametrize("exchanges", [6, 7, 50, 120, 178, 180, 181, 182])
def test_a_cable_pulled_at_any_moment_leaves_a_bootloader_that_takes_it_again(
    board: Bench, ours: Image, exchanges: int
) -> None:
    enter(board)
    converse(UsbHost(board), avr109.flash(ours, lambda _: None), exchanges)
    whole = program(board)[: len(ours.data)] == ours.data
    board.call("reset", POWER_ON)
    board.run(TIMEOUT_S + 1.0)
    assert runs(board) == whole
    if not whole:
        converse(UsbHost(board), avr109.flash(ours, lambda _: None))
        board.run_until(lambda: runs(board), START_S)
    board.run(0.02)
    assert board.number("REVISION") == ours.revision
