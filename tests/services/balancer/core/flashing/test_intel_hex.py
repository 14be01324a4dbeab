"""Intel HEX and what a firmware file must be, and real files beside avr-objcopy."""

import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.balancer.core.devices import balboa
from services.balancer.core.flashing import image, intel_hex
from swarm.errors import LocalError

GOLDEN = ":0400000001020304F2\n:00000001FF\n"


def record(kind: int, address: int, data: bytes) -> str:
    content = bytes((len(data), address >> 8, address & 255, kind)) + data
    return f":{(content + bytes((-sum(content) % 256,))).hex().upper()}\n"


def to_hex(data: bytes, at: int = 0, width: int = 16) -> str:
    lines = [record(0, (at + n) % 0x10000, data[n : n + width]) for n in range(0, len(data), width)]
    return "".join(lines) + record(1, 0, b"")


def firmware(layout: int = balboa.LAYOUT_VERSION, signature: bytes = image.SIGNATURE, size: int = 1000) -> bytes:
    mark = image.MARK + signature + bytes((layout, 7))
    return bytes(range(1, 251)) + mark + bytes(size - 250 - len(mark))


def test_a_file_as_written_down() -> None:
    assert intel_hex.parse(GOLDEN, 100) == b"\x01\x02\x03\x04"


@given(st.binary(min_size=1, max_size=600), st.integers(0, 300), st.integers(1, 64))
def test_what_was_written_is_read(data: bytes, at: int, width: int) -> None:
    assert intel_hex.parse(to_hex(data, at, width), 2000) == b"\xff" * at + data


@given(st.binary(min_size=1, max_size=200), st.data())
def test_one_wrong_digit_is_found(data: bytes, draw: st.DataObject) -> None:
    text = to_hex(data)
    digits = [place for place, letter in enumerate(text) if letter in "0123456789ABCDEF"]
    place = draw.draw(st.sampled_from(digits))
    digit = draw.draw(st.sampled_from("0123456789ABCDEF").filter(lambda digit: digit != text[place]))
    with pytest.raises(LocalError):
        intel_hex.parse(text[:place] + digit + text[place + 1 :], 2000)


@given(st.binary(min_size=1, max_size=200), st.data())
def test_a_file_that_was_cut_off_is_found(data: bytes, draw: st.DataObject) -> None:
    text = to_hex(data)
    with pytest.raises(LocalError):
        intel_hex.parse(text[: draw.draw(st.integers(0, len(text) - 2))], 2000)


@given(st.text())
def test_any_text_is_read_or_refused(text: str) -> None:
    with pytest.raises(LocalError):
        intel_hex.parse(text, 1000)


def test_intel_hex_is_read_with_segments_and_other_addresses() -> None:
    text = record(2, 0, b"\x00\x10") + record(0, 4, b"a") + record(4, 0, b"\x00\x00") + record(0, 0, b"b")
    text += record(3, 0, bytes(4)) + record(5, 0, bytes(4)) + record(1, 0, b"")
    assert intel_hex.parse(text, 1000) == b"b" + b"\xff" * 0x103 + b"a"


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("", "no end"),
        (record(0, 0, b"a"), "no end"),
        (record(1, 0, b""), "no bytes in it"),
        (GOLDEN + GOLDEN, "line 3: something behind the end"),
        (record(0, 0, b"a") + record(0, 0, b"b"), "line 2: another byte at 0x0"),
        (record(4, 0, b"\x00\x01") + record(0, 0, b"a"), "line 2: a byte at 0x10000; there is room for 100 bytes"),
        (record(0, 99, b"ab"), "line 1: a byte at 0x64; there is room for 100 bytes: too large"),
        (GOLDEN.replace("F2", "F3"), "line 1: its sum is wrong"),
        (GOLDEN.replace(":0400", ":0500"), "line 1: no Intel HEX"),
        (GOLDEN.replace("010203", "01 203"), "line 1: no Intel HEX"),
        ("\x7fELF", "line 1: no Intel HEX"),
        (record(6, 0, b""), "a record of type 6 with 0 bytes"),
        (record(1, 0, b"a"), "a record of type 1 with 1 bytes"),
    ],
)
def test_what_is_wrong_is_named(text: str, problem: str) -> None:
    with pytest.raises(LocalError, match=re.escape(problem)):
        intel_hex.parse(text, 100)


def test_a_firmware_says_what_it_is() -> None:
    found = image.read(to_hex(firmware()))
    assert (found.layout, found.revision) == (balboa.LAYOUT_VERSION, 7)
    assert found.data == firmware() + b"\xff" * 24
    assert [at for at, _ in found.pages] == list(range(0, 1024, 128))
    assert b"".join(data for _, data in found.pages) == found.data


@pytest.mark.parametrize(
    ("data", "problem"),
    [
        (bytes(1000), "no firmware of Balboa Swarm"),
        (firmware()[:275], "no firmware of Balboa Swarm"),
        (firmware(signature=b"\x1e\x95\x0f"), "made for ATmega328P, a Balboa 32U4 has an ATmega32U4"),
        (firmware(signature=b"\x01\x02\x03"), "made for a chip with signature 01 02 03"),
        (firmware(layout=9), "layout version 9, this release needs 2"),
        (firmware(size=image.ROOM + 1), "room for 28672 bytes: too large"),
    ],
)
def test_another_firmware_is_refused(data: bytes, problem: str) -> None:
    with pytest.raises(LocalError, match=problem):
        image.read(to_hex(data))


def test_the_largest_firmware_is_taken() -> None:
    assert len(image.read(to_hex(firmware(size=image.ROOM))).data) == image.ROOM
