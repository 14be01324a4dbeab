"""`swarm flash` against a stand-in for Pololu's bootloader: at its bytes, at a pseudo-terminal, and from a robot."""

import errno
import os
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from unittest.mock import Mock

import pytest
import serial
from caterina import FLASH, Caterina, Port
from hypothesis import given
from hypothesis import strategies as st
from test_intel_hex import firmware, to_hex

from services.balancer.core.devices import balboa
from services.balancer.core.flashing import avr109, image
from services.balancer.core.flashing.image import Image
from services.balancer.flash import flash, usb_port
from swarm.errors import LocalError, RemoteError

IMAGE = image.read(to_hex(firmware(size=3000)))


def converse(caterina: Caterina, conversation: avr109.Conversation, *, exchanges: int = 10**6) -> str:
    """Without a port; ends in a cable that is pulled after so many exchanges."""
    exchange = next(conversation)
    for _ in range(exchanges):
        answer = caterina.receive(exchange.request)
        assert len(answer) == exchange.answer
        try:
            exchange = conversation.send(answer)
        except StopIteration as end:
            return str(end.value)
    raise RemoteError("pulled")


def old_program(caterina: Caterina) -> None:
    caterina.flash[:] = bytes(n % 251 for n in range(FLASH))


@given(st.integers(280, 6000))
def test_a_firmware_comes_as_it_is(size: int) -> None:
    caterina, shares = Caterina(), list[float]()
    old_program(caterina)
    new = image.read(to_hex(firmware(size=size)))
    assert converse(caterina, avr109.flash(new, shares.append)) == "CATERIN"
    assert caterina.flash == new.data + b"\xff" * (FLASH - len(new.data))
    assert shares == sorted(shares)
    assert shares[-1] == 1.0
    assert caterina.tick(1.0)  # it leaves for the program at once


def test_the_first_page_comes_last() -> None:
    caterina = Caterina()
    converse(caterina, avr109.flash(IMAGE, lambda _: None))
    assert caterina.written[-1] == 0
    assert sorted(caterina.written) == [at for at, _ in IMAGE.pages]


@given(st.integers(0, 200))
def test_a_pulled_cable_leaves_a_bootloader_that_waits(exchanges: int) -> None:
    """Unless nothing was changed yet, or all of it is there."""
    caterina = Caterina()
    old_program(caterina)
    try:
        converse(caterina, avr109.flash(IMAGE, lambda _: None), exchanges=exchanges)
    except RemoteError:
        if caterina.has_program:
            whole = caterina.flash[: len(IMAGE.data)] == IMAGE.data
            assert whole or caterina.flash == bytes(n % 251 for n in range(FLASH))
        else:
            assert not caterina.tick(1000.0)
    converse(caterina, avr109.flash(IMAGE, lambda _: None))
    assert caterina.flash[: len(IMAGE.data)] == IMAGE.data


@pytest.mark.parametrize("at", [0, 256])
def test_a_worn_flash_is_found_and_not_started(at: int) -> None:
    caterina = Caterina()
    worn = True

    def break_at(address: int, data: bytes) -> bytes:
        return bytes((data[0] & 0x0F,)) + data[1:] if address == at and worn and data[0] != 0xFF else data

    caterina.break_at = break_at
    wrong = IMAGE._replace(data=b"\xf1" * len(IMAGE.data))
    with pytest.raises(RemoteError, match=f"holds something else at {at:#06x}"):
        converse(caterina, avr109.flash(wrong, lambda _: None))
    assert not caterina.has_program


def test_another_chip_is_left_alone() -> None:
    caterina = Caterina(signature=b"\x1e\x95\x8a")
    old_program(caterina)
    with pytest.raises(RemoteError, match="the bootloader is of ATmega32U2, a Balboa 32U4 has an ATmega32U4"):
        converse(caterina, avr109.flash(IMAGE, lambda _: None))
    assert caterina.flash == bytes(n % 251 for n in range(FLASH))


@given(st.lists(st.binary(min_size=1, max_size=8)))
def test_other_answers_are_refused(answers: list[bytes]) -> None:
    conversation = avr109.flash(IMAGE, lambda _: None)
    exchange = next(conversation)
    try:
        for answer in answers:
            exchange = conversation.send((answer * exchange.answer)[: exchange.answer])
    except RemoteError as error:
        assert str(error)  # noqa: PT017 - most lists end here, some do not


# -- at a pseudo-terminal ----------------------------------------------------------------------------------------


def said() -> tuple[list[str], Callable[[str], None]]:
    words: list[str] = []
    return words, words.append


def test_at_a_port_of_this_computer() -> None:
    words, say = said()
    with Port(Caterina()) as port:
        flash.at_port(IMAGE, port.path, say)
        assert port.caterina.flash[: len(IMAGE.data)] == IMAGE.data
    assert words[0] == f"flashing 3072 bytes at {port.path}"
    assert words[-1] == "written and read back: revision 7 (layout 2)"
    assert "50 %" in words


def test_a_cable_that_is_pulled_is_told() -> None:
    with Port(Caterina(), bytes_until_pulled=1000) as port, pytest.raises(RemoteError, match="press reset twice"):
        usb_port.converse(port.path, avr109.flash(IMAGE, lambda _: None))
    with pytest.raises(LocalError, match="/dev/no-such cannot be opened"):
        usb_port.converse("/dev/no-such", avr109.flash(IMAGE, lambda _: None))


def test_a_port_that_the_user_may_not_open_is_told_with_the_group_that_may(monkeypatch: pytest.MonkeyPatch) -> None:
    refused = serial.SerialException(errno.EACCES, "could not open port /dev/ttyACM0")
    monkeypatch.setattr(serial, "Serial", Mock(side_effect=refused))
    with pytest.raises(LocalError, match="group dialout"):
        usb_port.converse("/dev/ttyACM0", avr109.flash(IMAGE, lambda _: None))


@pytest.mark.skipif(shutil.which("avrdude") is None and not os.environ.get("CI"), reason="needs avrdude")
def test_the_stand_in_serves_avrdude_too(tmp_path: Path) -> None:
    """Somebody else's client of the same protocol, so that ours and its stand-in do not agree on a mistake."""
    (tmp_path / "new.hex").write_text(to_hex(firmware(size=3000)))
    with Port(Caterina()) as port:
        old_program(port.caterina)
        command = ["avrdude", "-p", "m32u4", "-c", "avr109", "-P", port.path, "-b", "57600"]
        done = subprocess.run(
            [*command, "-U", f"flash:w:{tmp_path}/new.hex:i"], capture_output=True, text=True, timeout=60
        )
        assert done.returncode == 0, done.stderr
        assert port.caterina.flash[: len(IMAGE.data)] == IMAGE.data


# -- finding the port --------------------------------------------------------------------------------------------


def add_port(sysfs: Path, name: str, vendor: str, product: str) -> None:
    device = sysfs.parent / f"usb-{name}"
    (device / "interface").mkdir(parents=True)
    (device / "idVendor").write_text(f"{vendor}\n")
    (device / "idProduct").write_text(f"{product}\n")
    (sysfs / name).mkdir(parents=True)
    (sysfs / name / "device").symlink_to(device / "interface")


def test_a_bootloader_is_found_by_its_ids(tmp_path: Path) -> None:
    sysfs = tmp_path / "tty"
    (sysfs / "tty0").mkdir(parents=True)
    add_port(sysfs, "ttyACM0", "1366", "0105")
    with pytest.raises(RemoteError, match=r"no bootloader has come to a USB port within 0\.3 s"):
        usb_port.wait_for_bootloader(0.3, sysfs, lambda _: None)
    add_port(sysfs, "ttyACM1", "1ffb", "0101")
    assert usb_port.wait_for_bootloader(0.3, sysfs, lambda _: None) == "/dev/ttyACM1"
    add_port(sysfs, "ttyACM2", "1ffb", "0101")
    with pytest.raises(LocalError, match="several bootloaders wait, at /dev/ttyACM1, /dev/ttyACM2"):
        usb_port.wait_for_bootloader(0.3, sysfs, lambda _: None)


def test_a_system_that_does_not_list_its_ports_wants_one_named(tmp_path: Path) -> None:
    with pytest.raises(LocalError, match="name its port with --port"):
        usb_port.wait_for_bootloader(5.0, tmp_path / "tty", lambda _: None)


def test_a_bootloader_that_comes_late_is_waited_for(tmp_path: Path) -> None:
    (tmp_path / "tty").mkdir()
    looks = iter(range(100))

    def sleep(_: float) -> None:
        if next(looks) == 3:
            add_port(tmp_path / "tty", "ttyACM0", "1ffb", "0101")

    assert usb_port.wait_for_bootloader(5.0, tmp_path / "tty", sleep) == "/dev/ttyACM0"


# -- on a robot --------------------------------------------------------------------------------------------------


class Board:
    """A Balboa at both of its ends: I2C while a firmware runs, USB while its bootloader does."""

    def __init__(self, revision: int | None = 1, layout: int = 1) -> None:
        self.layout, self.revision = layout, revision
        self.in_bootloader = revision is None
        self.motors: bytes | None = None
        self._index = 0

    def new(self, caterina: Caterina) -> None:
        """What runs after the bootloader."""
        found = image.read(to_hex(bytes(caterina.flash).rstrip(b"\xff")))
        self.layout, self.revision, self.in_bootloader = found.layout, found.revision, False

    def write(self, address: int, data: bytes) -> None:
        self._answer(address)
        self._index = data[0]
        if data[0] == balboa.MOTORS:
            self.motors = data[1:]
        if data[0] == balboa.COMMAND and data[1:] == balboa.BOOTLOADER_COMMAND.to_bytes(2, "little"):
            self.in_bootloader = True

    def read(self, address: int, count: int) -> bytes:
        self._answer(address)
        memory = bytearray(256)
        memory[balboa.VERSION], memory[balboa.REVISION] = self.layout, self.revision or 0
        return bytes(memory[self._index : self._index + count])

    def write_read(self, address: int, data: bytes, count: int) -> bytes:
        self.write(address, data)
        return self.read(address, count)

    def recover(self) -> None: ...
    def pause(self, seconds: float) -> None: ...
    def untimed(self) -> float:
        return 0.0

    def close(self) -> None: ...

    def _answer(self, address: int) -> None:
        if self.in_bootloader or address != balboa.ADDRESS:
            raise OSError(121, "Remote I/O error")


@pytest.fixture
def systemctl(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    actions: list[str] = []
    monkeypatch.setattr(flash, "_systemctl", actions.append)
    monkeypatch.setattr(flash, "_mode", lambda: "idle")
    monkeypatch.setattr(os, "geteuid", lambda: 0)
    return actions


def flash_here(board: Board, image: Image = IMAGE, **options: bool) -> list[str]:
    words, say = said()
    with Port(Caterina()) as port:

        def wait(seconds: float) -> str:
            assert board.in_bootloader
            return port.path

        real = usb_port.converse

        def converse(path: str, conversation: avr109.Conversation) -> str:
            name = real(path, conversation)
            board.new(port.caterina)
            return name

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(usb_port, "converse", converse)
            flash.here(image, say, lambda: board, force=options.get("force", False), wait=wait)
    return words


def test_a_robot_is_flashed(systemctl: list[str]) -> None:
    board = Board()
    words = flash_here(board)
    assert (board.revision, board.motors) == (7, bytes(4))
    assert systemctl == ["stop", "start"]
    assert words[0] == "revision 1 before (layout 1)"


@pytest.mark.parametrize(("revision", "layout"), [(None, 1), (3, 9)])
def test_one_with_another_firmware_or_none_too(systemctl: list[str], revision: int | None, layout: int) -> None:
    board = Board(revision, layout)
    words = flash_here(board)
    assert board.revision == 7
    assert ("press reset twice" in " ".join(words)) == (revision is None)


def test_the_balancer_runs_again_where_it_failed(systemctl: list[str]) -> None:
    def wait(seconds: float) -> str:
        raise RemoteError("no bootloader has come")

    with pytest.raises(RemoteError, match="no bootloader has come"):
        flash.here(IMAGE, lambda _: None, Board, force=False, wait=wait)
    assert systemctl == ["stop", "start"]


def test_a_firmware_that_does_not_answer_is_told(systemctl: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(flash, "START_S", 0.2)
    monkeypatch.setattr(Board, "new", lambda *_: None)
    with pytest.raises(RemoteError, match="over I2C nobody answers: switch the robot's power"):
        flash_here(Board())
    assert systemctl == ["stop", "start"]


def test_a_robot_that_stands_is_not_flashed(systemctl: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(flash, "_mode", lambda: "balancing")
    board = Board()
    with pytest.raises(LocalError, match="the robot is balancing, and would fall"):
        flash_here(board)
    assert (systemctl, board.revision) == ([], 1)
    flash_here(board, force=True)
    assert board.revision == 7


def test_flashing_the_own_board_needs_root(systemctl: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    with pytest.raises(LocalError, match="needs root"):
        flash_here(Board())


def test_an_absent_board_has_no_version_and_no_bootloader() -> None:
    nobody = Board(None)
    assert flash.versions(nobody) is None
    assert not flash.enter_bootloader(nobody)
