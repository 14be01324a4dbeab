"""Frames: golden bytes of docs/reference/network/frames.md, any split of a stream, and whatever bytes a peer may
send."""

import re
import struct
from contextlib import suppress
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.mesh.core.link.clock import ClockClaim, decode_claim, encode_claim
from services.mesh.core.link.flow import Fragment, decode_ack, decode_fragment, encode_ack, encode_fragment
from services.mesh.core.node import COUNTERS
from services.mesh.core.wire import frames
from services.mesh.core.wire.frames import Bind, Frame, FrameDecoder, Heartbeat, Hello
from swarm.errors import FrameError, LocalError

HELLO = Hello("lab", "r0", 0x1122334455667788, bytes(range(16)), dialler=True, insecure=True)

GOLDEN = {
    "hello": frames.encode_hello(HELLO),
    "confirm": frames.encode_confirm(),
    "bye": frames.encode_bye(frames.CLOSING),
    "heartbeat": frames.encode_heartbeat(Heartbeat(1_000_000, 1_030_000, 1_500_000)),
    "bind": frames.encode_bind(Bind(3, frames.NEIGHBOURS, "swarm/r0/dwm/pose")),
    "data": frames.encode_data(frames.SYNC, 3, b"\x01\x02\0\0\0"),
    "fragment": encode_fragment(Fragment(3, 0, False, 5, b"abc")),
    "last": encode_fragment(Fragment(3, 1, True, 0, b"de")),
    "ack": encode_ack(0x01020304),
    "clock": encode_claim(ClockClaim("r0", 0x11223344, 7, 2, False, True, 1.5, -0.25, 0.0, 0.0009765625)),
}

DOCUMENT = Path(__file__).parents[5] / "docs/reference/network/frames.md"


def body_of(encoded: bytes) -> bytes:
    (frame,) = FrameDecoder(frames.MAX_FRAME).frames(encoded)
    return frame.body


@pytest.mark.parametrize("name", GOLDEN)
def test_the_bytes_are_those_of_the_document(name: str) -> None:
    (line,) = re.findall(rf"^{name} +((?:[0-9a-f]{{2}} ?)+)$", DOCUMENT.read_text(), re.MULTILINE)
    assert GOLDEN[name] == bytes.fromhex(line)


def test_the_document_knows_every_bye_code() -> None:
    text = DOCUMENT.read_text()
    for code, meaning in frames.BYE_TEXT.items():
        assert f"| {code} | {meaning} |" in text


def test_the_document_knows_every_counter() -> None:
    text = DOCUMENT.read_text() + "\n## " + (DOCUMENT.parent / "overlay-packets.md").read_text() + "\n## "
    documented = set(re.findall(r"`(\w+)`", "".join(re.findall(r"## Counters\n(.*?)\n## ", text, re.DOTALL))))
    documented |= {"refused" + name for name in documented if name.startswith("_")}
    assert set(COUNTERS) <= documented


names = st.from_regex(r"[a-z][a-z0-9_-]{0,15}", fullmatch=True)
hellos = st.builds(
    Hello,
    network=st.text(min_size=1, max_size=8),
    robot=names,
    incarnation=st.integers(0, 2**64 - 1),
    nonce=st.binary(min_size=16, max_size=16),
    dialler=st.booleans(),
    insecure=st.just(True),
) | st.builds(
    Hello,
    network=st.just("lab"),
    robot=names,
    incarnation=st.just(1),
    nonce=st.just(bytes(16)),
    dialler=st.booleans(),
    insecure=st.just(False),
    key_ids=st.lists(st.integers(0, 2**32 - 1), max_size=4).map(tuple),
)
stamps = st.integers(0, 2**64 - 1)


@given(hellos)
def test_a_hello_frame_survives_encoding(hello: Hello) -> None:
    assert frames.decode_hello(body_of(frames.encode_hello(hello))) == hello
    assert len(frames.encode_hello(hello)) <= frames.MAX_HANDSHAKE


@given(st.builds(Heartbeat, stamps, stamps, stamps))
def test_a_heartbeat_frame_survives_encoding(heartbeat: Heartbeat) -> None:
    assert frames.decode_heartbeat(body_of(frames.encode_heartbeat(heartbeat))) == heartbeat


@given(st.integers(0, 1023), st.text(min_size=1, max_size=60))
def test_a_bind_frame_survives_encoding(channel: int, key: str) -> None:
    bind = Bind(channel, frames.NEIGHBOURS, key)
    assert frames.decode_bind(body_of(frames.encode_bind(bind))) == bind


@given(st.integers(0, 65535), st.binary(max_size=100), st.sampled_from((0, 1, 2)))
def test_a_data_frame_survives_encoding(channel: int, payload: bytes, priority: int) -> None:
    (frame,) = FrameDecoder(frames.MAX_FRAME).frames(frames.encode_data(priority, channel, payload))
    assert (frame.kind, frame.priority) == (frames.DATA, priority)
    assert frames.decode_data(frame.body) == (channel, payload)


encoded_frames = st.one_of(
    st.sampled_from(list(GOLDEN.values())),
    st.builds(frames.encode_data, st.sampled_from((0, 1, 2)), st.integers(0, 9), st.binary(max_size=300)),
)


@given(st.lists(encoded_frames, max_size=12), st.data())
def test_any_split_of_the_stream_gives_the_same_frames(parts: list[bytes], data: st.DataObject) -> None:
    stream = b"".join(parts)
    whole = list(FrameDecoder(frames.MAX_FRAME).frames(stream))
    cuts = sorted(data.draw(st.lists(st.integers(0, len(stream)), max_size=20)))
    pieces = FrameDecoder(frames.MAX_FRAME)
    found: list[Frame] = []
    for start, end in zip([0, *cuts], [*cuts, len(stream)], strict=True):
        found += pieces.frames(stream[start:end])
    assert found == whole
    assert len(found) == len(parts)


DECODERS = {
    frames.HELLO: frames.decode_hello,
    frames.CONFIRM: frames.decode_confirm,
    frames.BYE: frames.decode_bye,
    frames.HEARTBEAT: frames.decode_heartbeat,
    frames.BIND: frames.decode_bind,
    frames.DATA: frames.decode_data,
    frames.FRAGMENT: decode_fragment,
    frames.ACK: decode_ack,
    frames.CLOCK: decode_claim,
}


@given(st.binary(max_size=600), st.integers(1, 50))
def test_noise_raises_frame_errors_only_and_stays_small(noise: bytes, step: int) -> None:
    decoder = FrameDecoder()
    with suppress(FrameError):
        for at in range(0, len(noise), step):
            for frame in decoder.frames(noise[at : at + step]):
                DECODERS[frame.kind](frame.body)
            assert len(decoder._rest) <= frames.MAX_HANDSHAKE + 2 + step


@given(st.sampled_from(list(GOLDEN.values())), st.data())
def test_mutated_frames_raise_frame_errors_only(encoded: bytes, data: st.DataObject) -> None:
    mutated = bytearray(encoded)
    for _ in range(data.draw(st.integers(1, 4))):
        mutated[data.draw(st.integers(0, len(mutated) - 1))] = data.draw(st.integers(0, 255))
    with suppress(FrameError):
        for frame in FrameDecoder(frames.MAX_FRAME).frames(bytes(mutated)):
            DECODERS[frame.kind](frame.body)


@given(st.binary(max_size=80), st.sampled_from(list(DECODERS)))
def test_any_body_raises_frame_errors_only(body: bytes, kind: int) -> None:
    with suppress(FrameError):
        DECODERS[kind](body)


@pytest.mark.parametrize("length", [0, 257, 4097, 65535])
def test_the_length_is_refused_before_anything_else_is_read(length: int) -> None:
    with pytest.raises(FrameError, match=f"length {length}: 1 to 256"):
        list(FrameDecoder().frames(struct.pack("<H", length)))


@pytest.mark.parametrize(
    ("first", "text"),
    [(0x00, "kind 0"), (0x0A, "kind 10"), (0x0F, "kind 15"), (0x31, "class 3"), (0x46, "class 4")],
)
def test_unknown_kinds_and_classes_are_refused(first: int, text: str) -> None:
    with pytest.raises(FrameError, match=text):
        list(FrameDecoder().frames(bytes((1, 0, first))))


def test_bytes_too_many_are_refused() -> None:
    for name, decode in (("hello", frames.decode_hello), ("heartbeat", frames.decode_heartbeat)):
        with pytest.raises(FrameError, match=name.upper()):
            decode(body_of(GOLDEN[name]) + b"\0")
    with pytest.raises(FrameError, match="CONFIRM"):
        frames.decode_confirm(b"\0")
    with pytest.raises(FrameError, match="BYE"):
        frames.decode_bye(b"\1\1")


def test_another_version_is_told_from_noise_whatever_follows() -> None:
    body = frames.MAGIC + bytes((4, 7)) + b"a layout of the future"
    with pytest.raises(frames.VersionError, match="speaks protocol versions 4 to 7, we speak 3"):
        frames.decode_hello(body)
    with pytest.raises(FrameError, match="not one of ours") as caught:
        frames.decode_hello(b"GET / HTTP/1.1")
    assert not isinstance(caught.value, frames.VersionError)


def test_what_does_not_fit_is_our_own_mistake() -> None:
    with pytest.raises(LocalError, match="1 to 32 bytes"):
        frames.encode_hello(Hello("n" * 33, "r0", 1, bytes(16), dialler=True, insecure=True))
    with pytest.raises(LocalError, match="at most 4088"):
        frames.encode(frames.BIND, frames.CONTROL, bytes(frames.MAX_FRAME))


def test_the_header_of_a_lockstep_message_is_short() -> None:
    lockstep_header = 5  # kind and iteration, docs/reference/network/lockstep.md
    header = len(frames.encode_data(frames.SYNC, 1, b"")) + frames.TAG_SIZE + lockstep_header
    assert header == 18


def test_the_largest_payload_leaves_room_for_the_tag() -> None:
    encoded = frames.encode_data(frames.BULK, 0, bytes(frames.MAX_PAYLOAD))
    assert len(encoded) - 2 + frames.TAG_SIZE == frames.MAX_FRAME
