"""Lockstep: the bytes of channels, frames and snapshots."""

import dataclasses
from contextlib import suppress

import pytest
from hypothesis import given
from hypothesis import strategies as st
from lockstep_core import OURS, THEIRS, started
from lockstep_world import RUN, SCHEMA

from swarm.core.lockstep.frames import (
    Channel,
    HeardNeighbour,
    Snapshot,
    Step,
    Want,
    decode_frame,
    encode_step,
    encode_want,
)
from swarm.errors import FrameError, LocalError


def test_channel_text_is_one_key_chunk():
    assert OURS.text == "00000000000000a1-0-3-9f3c21aa"
    assert Channel.parse("00000000000000a1-0-3-9f3c21aa") == OURS


@given(
    st.builds(
        Channel,
        st.integers(0, 2**64 - 1),
        st.integers(0, 2**32 - 1),
        st.integers(0, 2**64 - 1),
        st.integers(0, 2**32 - 1),
    )
)
def test_channel_comes_back_from_its_text(channel):
    assert Channel.parse(channel.text) == channel


@pytest.mark.parametrize(
    "text",
    [
        "",
        "a1-0-3-9f3c21aa",
        "00000000000000A1-0-3-9f3c21aa",
        "00000000000000a1-00-3-9f3c21aa",
        "00000000000000a1-0-03-9f3c21aa",
        "00000000000000a1--1-3-9f3c21aa",
        "00000000000000a1-0-3-9f3c21aa\n",
        "00000000000000a1-4294967296-3-9f3c21aa",
        "00000000000000a1-0-18446744073709551616-9f3c21aa",
        "00000000000000a1-0-٣-9f3c21aa",
    ],
)
def test_a_channel_has_only_one_text(text):
    with pytest.raises(FrameError):
        Channel.parse(text)


@given(st.text(max_size=70))
def test_any_text_is_a_channel_or_a_frame_error(text):
    with suppress(FrameError):
        assert Channel.parse(text).text == text


@pytest.mark.parametrize("field", ["run", "epoch", "incarnation", "schema"])
def test_channel_refuses_numbers_that_do_not_fit(field):
    for value in (-1, 2**64):
        with pytest.raises(LocalError, match=field):
            dataclasses.replace(OURS, **{field: value})


def test_frames_of_the_lockstep_have_these_bytes():
    assert encode_step(0, b"ab", None).hex() == "01" + "00000000" + "6162"
    assert encode_step(0x01020304, b"ab", b"cd").hex() == "01" + "04030201" + "6162" + "6364"
    assert encode_want(7).hex() == "02" + "07000000"
    assert decode_frame(bytes.fromhex("01000000006162"), 2) == Step(0, b"ab", None)
    assert decode_frame(bytes.fromhex("010403020161626364"), 2) == Step(0x01020304, b"ab", b"cd")
    assert decode_frame(bytes.fromhex("0207000000"), 2) == Want(7)


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"\x01\0\0\0",
        b"\x00\0\0\0\0ab",
        b"\x03\0\0\0\0ab",
        encode_want(1) + b"!",
        encode_step(0, b"ab", b"cd"),
        encode_step(1, b"ab", None),
        encode_step(1, b"ab", b"c"),
        encode_step(1, b"ab", b"cde"),
    ],
)
def test_malformed_frames_are_refused_and_counted(data):
    with pytest.raises(FrameError):
        decode_frame(data, 2)
    one = started()
    one.receive("r1", THEIRS, data, 0.0)
    assert one.counters == {"malformed": 1}
    assert one.actions() == []


@given(st.binary(max_size=40), st.integers(0, 8))
def test_any_bytes_are_a_frame_or_a_frame_error(data, size):
    try:
        frame = decode_frame(data, size)
    except FrameError:
        return
    assert data == (encode_want(frame.k) if isinstance(frame, Want) else encode_step(*frame))


SNAPSHOT = Snapshot(
    run=RUN,
    epoch=2,
    schema=SCHEMA,
    size=2,
    k=7,
    value=b"a7",
    previous=b"a6",
    heard={"r1": HeardNeighbour(5, 8, [b"b6", b"b7", b"b8"]), "r2": HeardNeighbour()},
    private=b"secret",
)
SNAPSHOT_BYTES = bytes.fromhex(
    "424c5331"  # BLS1
    "a100000000000000 02000000 aa213c9f 02000000 07000000"  # run, epoch, schema, size, k
    "02 06000000"  # neighbours, length of the private part
    "6137 6136"  # own x(7), x(6)
    "0500000000000000 01 08000000 07 02 7231 6236 6237 6238"  # incarnation, known, reached, slots, name, values
    "0000000000000000 00 00000000 00 02 7232"  # nothing known of r2 yet
    "736563726574"  # private
    "ab4cf8dd"  # crc32
)


def test_a_snapshot_has_these_bytes():
    assert SNAPSHOT.encode().hex() == SNAPSHOT_BYTES.hex()
    assert Snapshot.decode(SNAPSHOT_BYTES) == SNAPSHOT


@given(st.data())
def test_a_snapshot_that_is_not_whole_is_refused(data):
    cut = data.draw(st.integers(0, len(SNAPSHOT_BYTES) - 1))
    bit = data.draw(st.integers(0, 8 * len(SNAPSHOT_BYTES) - 1))
    flipped = bytearray(SNAPSHOT_BYTES)
    flipped[bit // 8] ^= 1 << bit % 8
    for wrong in (SNAPSHOT_BYTES[:cut], bytes(flipped), SNAPSHOT_BYTES + b"!"):
        with pytest.raises(LocalError, match=r"snapshot: (not one|truncated or damaged)"):
            Snapshot.decode(wrong)


@given(st.binary(max_size=80))
def test_any_bytes_are_no_snapshot(data):
    for wrong in (data, b"BLS1" + data):
        with pytest.raises(LocalError, match="snapshot"):
            Snapshot.decode(wrong)
