"""Authentication: key derivation, golden bytes, and that two sessions deliver nothing but what was sent, in order."""

import hashlib
import hmac
import re
import struct
from collections import Counter
from pathlib import Path

import pytest
from conftest import costly
from hypothesis import given
from hypothesis import strategies as st

from services.mesh.core.link import LinkUp, Received, flow
from services.mesh.core.link.calls import Local, process_of
from services.mesh.core.link.clock import ClockClaim, ClockSync, encode_claim
from services.mesh.core.link.session import Session
from services.mesh.core.wire import frames
from services.mesh.core.wire.auth import Keys, Tagger, hkdf, newest_common
from services.mesh.core.wire.frames import Bind, FrameDecoder, Heartbeat, Hello
from swarm.errors import FrameError

KEY_ID, SECRET = 0x68A1F0C2, bytes(range(32))
KEYS = {KEY_ID: SECRET}
DOCUMENT = (Path(__file__).parents[5] / "docs/reference/network/frames.md").read_text()

DIALLER = Hello("lab", "r0", 0x1122334455667788, bytes(range(16)), dialler=True, insecure=False, key_ids=(KEY_ID,))
LISTENER = Hello(
    "lab", "r1", 0x99AABBCCDDEEFF00, bytes(range(16, 32)), dialler=False, insecure=False, key_ids=(KEY_ID,)
)
SEALED = ("sealed-heartbeat", "sealed-clock", "sealed-ack", "sealed-bind", "sealed-data")
D, L = frames.encode_hello(DIALLER), frames.encode_hello(LISTENER)


def golden(name: str) -> bytes:
    (line,) = re.findall(rf"^{name} +((?:[0-9a-f]{{2}} ?)+)$", DOCUMENT, re.MULTILINE)
    return bytes.fromhex(line)


def session(robot: str, keys: dict[int, bytes] = KEYS) -> Session:
    """One end of the golden connection: r0 dials r1."""
    hello, peer = (DIALLER, "r1") if robot == "r0" else (LISTENER, "r0")
    local = Local(robot, "lab", hello.incarnation, not keys, {peer: robot == "r0"}, frozenset(("r0", "r1")), keys=keys)
    dialled = peer if robot == "r0" else None
    clock = ClockSync(local.robot, local.incarnation, local.robots)
    return Session(local, hello.nonce, 0.0, dialled=dialled, admit=lambda *_: True, clock=clock, counters=Counter())


def connected(keys: dict[int, bytes] = KEYS, now: float = 0.0) -> tuple[Session, Session]:
    one, other = session("r0", keys), session("r1", keys)
    for _ in range(2):
        to_other, to_one = one.data_to_send(now, 4096), other.data_to_send(now, 4096)
        other.receive(to_other, now)
        one.receive(to_one, now)
    for each in (one, other):
        assert [type(event) for event in each.events()] == [LinkUp]
    return one, other


# -- derivation ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("secret", "salt", "info", "length", "expected"),
    [  # RFC 5869, A.1 to A.3
        (
            "0b" * 22,
            "000102030405060708090a0b0c",
            "f0f1f2f3f4f5f6f7f8f9",
            42,
            "3cb25f25faacd57a90434f64d0362f2a2d2d0a90cf1a5a4c5db02d56ecc4c5bf34007208d5b887185865",
        ),
        (
            bytes(range(0x50)).hex(),
            bytes(range(0x60, 0xB0)).hex(),
            bytes(range(0xB0, 0x100)).hex(),
            82,
            "b11e398dc80327a1c8e7f78c596a49344f012eda2d4efad8a050cc4c19afa97c59045a99cac7827271cb41c65e590e09"
            "da3275600c2f09b8367793a9aca3db71cc30c58179ec3e87c14c01d5c1f3434f1d87",
        ),
        (
            "0b" * 22,
            "",
            "",
            42,
            "8da4e775a563c18f715f802a063c5a31b8a11f5c5ee1879ec3454e5f3c738d2d9d201395faa4b61a96c8",
        ),
    ],
)
def test_hkdf_is_that_of_the_standard(secret: str, salt: str, info: str, length: int, expected: str) -> None:
    found = hkdf(bytes.fromhex(secret), bytes.fromhex(salt), bytes.fromhex(info), length)
    assert found.hex() == expected


def test_the_newest_common_key_is_used() -> None:
    assert newest_common({3: b"", 9: b""}, (9, 3)) == 9
    assert newest_common((3, 9), (3, 4)) == 3
    assert newest_common((3, 9), (4,)) is None
    assert newest_common((), ()) is None


def by_the_document() -> tuple[bytes, bytes, bytes, bytes]:
    """CONFIRM's MACs and the keys of the frames, by the formulas of docs/reference/network/frames.md written out."""
    info = b"balboa-swarm mesh, HKDF-SHA256 HMAC-SHA256 BLAKE2b-64" + struct.pack("<BI", frames.VERSION, KEY_ID)
    extracted = hmac.new(hashlib.sha256(D + L).digest(), SECRET, "sha256").digest()
    blocks = [b""]
    for count in range(1, 5):
        blocks.append(hmac.new(extracted, blocks[-1] + info + bytes((count,)), "sha256").digest())
    confirms = [hmac.new(key, D + L, "sha256").digest() for key in blocks[1:3]]
    return confirms[0], confirms[1], blocks[3], blocks[4]


def test_the_golden_bytes_follow_from_the_formulas_of_the_document() -> None:
    assert (golden("dialler-hello"), golden("listener-hello")) == (D, L)
    confirm_d, confirm_l, frames_d, frames_l = by_the_document()
    assert golden("dialler-confirm") == b"\x21\x00\x02" + confirm_d
    assert golden("listener-confirm") == b"\x21\x00\x02" + confirm_l
    for count, name in enumerate(SEALED):
        frame, tag = golden(name)[:-8], golden(name)[-8:]
        assert tag == hashlib.blake2b(struct.pack("<Q", count) + frame, key=frames_d, digest_size=8).digest()
    frame, tag = golden("sealed-bye")[:-8], golden("sealed-bye")[-8:]
    assert tag == hashlib.blake2b(bytes(8) + frame, key=frames_l, digest_size=8).digest()


def test_sessions_speak_the_golden_bytes() -> None:
    one, other = session("r0"), session("r1")
    assert one.data_to_send(0.0, 4096) == D
    assert other.data_to_send(0.0, 4096) == L
    one.receive(L, 0.0)
    other.receive(D, 0.0)
    assert one.data_to_send(0.0, 4096) == golden("dialler-confirm")
    assert other.data_to_send(0.0, 4096) == golden("listener-confirm")
    assert not one.events()
    assert not other.events()
    one.receive(golden("listener-confirm"), 1.0)
    one.queue.push(frames.SYNC, "swarm/r0/dwm/pose", b"\x01\x02\0\0\0", latest=False)
    expected = b"".join(golden(name) for name in SEALED)
    assert one.data_to_send(1.0, 4096) == expected
    other.receive(golden("dialler-confirm") + expected, 1.0)
    assert other.events() == [
        LinkUp("r0"),
        Received("swarm/r0/dwm/pose", b"\x01\x02\0\0\0", frames.SYNC),
    ]
    assert other.process == process_of(0x1122334455667788)
    other.close(frames.CLOSING, "stopping")
    assert other.data_to_send(1.0, 4096) == golden("sealed-bye")
    one.receive(golden("sealed-bye"), 1.0)
    assert one.state == "down"
    assert "stopping" in one.events()[-1].reason


def test_the_examples_are_frames_of_the_codec() -> None:
    tagger = Keys(SECRET, KEY_ID, frames.VERSION, D, L, dialler=True).outbound
    assert frames.seal(frames.encode_heartbeat(Heartbeat(0, 0, 1_000_000)), tagger) == golden("sealed-heartbeat")
    own_root = ClockClaim("r0", 0x55667788, 1, 0, False, False, 1.0, 0.0, 0.0, 0.0)
    assert frames.seal(encode_claim(own_root), tagger) == golden("sealed-clock")
    assert frames.seal(flow.encode_ack(len(D) + len(golden("dialler-confirm"))), tagger) == golden("sealed-ack")
    assert frames.seal(frames.encode_bind(Bind(0, 0, "swarm/r0/dwm/pose")), tagger) == golden("sealed-bind")


@given(st.sampled_from(("ours", "theirs")), st.data())
def test_every_bit_of_both_hellos_changes_every_key(whose: str, data: st.DataObject) -> None:
    hellos = {"ours": D, "theirs": L}
    changed = bytearray(hellos[whose])
    changed[data.draw(st.integers(0, len(changed) - 1))] ^= 1 << data.draw(st.integers(0, 7))
    right = Keys(SECRET, KEY_ID, 1, D, L, dialler=True)
    wrong = Keys(SECRET, KEY_ID, 1, **(hellos | {whose: bytes(changed)}), dialler=True)
    assert right.confirm != wrong.confirm
    assert right.outbound(b"") != wrong.outbound(b"")
    assert right.inbound(b"") != wrong.inbound(b"")


def test_key_id_version_secret_and_role_change_the_keys() -> None:
    found = {
        Keys(secret, key_id, version, D, L, dialler=dialler).confirm
        for secret in (SECRET, bytes(32))
        for key_id in (KEY_ID, 1)
        for version in (1, 2)
        for dialler in (True, False)
    }
    assert len(found) == 16


def test_directions_and_purposes_have_keys_of_their_own() -> None:
    one, other = (Keys(SECRET, KEY_ID, 1, *hellos, dialler=hellos[0] is D) for hellos in ((D, L), (L, D)))
    assert one.confirms(other.confirm)
    assert other.confirms(one.confirm)
    assert not one.confirms(one.confirm), "a reflected CONFIRM"
    assert one.outbound(b"frame") == other.inbound(b"frame")
    assert one.outbound(b"frame") != one.inbound(b"frame")


# -- tags ----------------------------------------------------------------------------------------------------


@given(st.lists(st.binary(max_size=200), max_size=10), st.data())
def test_sealed_frames_come_through_any_split(payloads: list[bytes], data: st.DataObject) -> None:
    tagger, decoder = Tagger(SECRET), FrameDecoder(frames.MAX_FRAME)
    decoder.tag = Tagger(SECRET)
    stream = b"".join(frames.seal(frames.encode_data(1, 5, payload), tagger) for payload in payloads)
    cuts = sorted(data.draw(st.lists(st.integers(0, len(stream)), max_size=20)))
    found = []
    for start, end in zip([0, *cuts], [*cuts, len(stream)], strict=True):
        found += [frames.decode_data(frame.body) for frame in decoder.frames(stream[start:end])]
    assert found == [(5, payload) for payload in payloads]


def test_the_counter_does_not_end_with_32_bits() -> None:
    tags = {Tagger(SECRET, count)(b"frame") for count in (0, 1, 2**32, 2**32 + 1, 2**64 - 1)}
    assert len(tags) == 5


@pytest.mark.parametrize("length", range(1, 9))
def test_a_frame_without_room_for_its_tag_is_refused(length: int) -> None:
    decoder = FrameDecoder(frames.MAX_FRAME)
    decoder.tag = Tagger(SECRET)
    with pytest.raises(frames.TagError, match="no room"):
        list(decoder.frames(struct.pack("<H", length) + bytes(length)))


def test_the_largest_payload_and_its_tag_fill_a_frame() -> None:
    sealed = frames.seal(frames.encode_data(frames.BULK, 0, bytes(frames.MAX_PAYLOAD)), Tagger(SECRET))
    assert len(sealed) - 2 == frames.MAX_FRAME


def test_an_authenticated_lockstep_message_costs_18_bytes() -> None:
    one, _ = connected()
    key = "swarm/r0/app/consensus/sync/00000000000000a1-0-3-9f3c21aa"
    lockstep = struct.pack("<BI", 1, 7)  # kind and iteration, docs/reference/network/lockstep.md
    sizes = []
    for _ in range(2):
        one.queue.push(frames.SYNC, key, lockstep + b"value", latest=False)
        sizes.append(len(one.data_to_send(0.0, 4096)))
    assert sizes[1] - len(b"value") == 18


# -- whatever happens on the way -----------------------------------------------------------------------------

KEY = "swarm/{}/app/x/sync/y"

tampering = st.one_of(
    st.tuples(st.just("flip"), st.integers(0, 400), st.integers(0, 7)),
    st.tuples(st.just("cut out"), st.integers(0, 400), st.integers(1, 80)),
    st.tuples(st.just("repeat"), st.integers(0, 400), st.integers(1, 80)),
    st.tuples(st.just("swap"), st.integers(0, 400), st.integers(1, 80)),
    st.tuples(st.just("insert"), st.integers(0, 400), st.binary(min_size=1, max_size=60)),
    st.tuples(st.just("reflect"), st.integers(0, 400), st.integers(1, 80)),
)


def tamper(stream: bytes, other_way: bytes, what: str, at: int, how: int | bytes) -> bytes:
    """A stream as somebody between two ends changes it."""
    match what:
        case "insert":
            assert isinstance(how, bytes)
            return stream[:at] + how + stream[at:]
        case "flip":
            return stream[:at] + bytes(byte ^ 1 << how for byte in stream[at : at + 1]) + stream[at + 1 :]
        case "cut out":
            return stream[:at] + stream[at + how :]
        case "repeat":
            return stream[: at + how] + stream[at:]
        case "swap":
            return stream[:at] + stream[at + how : at + 2 * how] + stream[at : at + how] + stream[at + 2 * how :]
        case _:
            return stream[:at] + other_way[at : at + how] + stream[at:]


@costly(400)
@given(
    st.lists(st.tuples(st.booleans(), st.binary(min_size=1, max_size=30)), max_size=20),
    st.lists(st.tuples(st.integers(0, 3), st.booleans(), tampering), max_size=3),
    st.integers(1, 3000),
)
def test_nothing_arrives_but_a_prefix_of_what_was_sent(
    messages: list[tuple[bool, bytes]], attacks: list[tuple[int, bool, tuple[str, int, int | bytes]]], step: int
) -> None:
    """Handshake and messages in four rounds; in each the bytes under way may be changed in any manner."""
    ends = session("r0"), session("r1")
    sent: tuple[list[bytes], list[bytes]] = ([], [])
    arrived: tuple[list[bytes], list[bytes]] = ([], [])
    share = len(messages) // 2 + 1
    for turn in range(4):
        if turn >= 2:
            for from_first, payload in messages[(turn - 2) * share : (turn - 1) * share]:
                sender = 0 if from_first else 1
                if ends[sender].is_up:
                    ends[sender].queue.push(frames.SYNC, KEY.format(f"r{sender}"), payload, latest=False)
                    sent[sender].append(payload)
        streams = [end.data_to_send(0.0, 1 << 20) for end in ends]
        for when, first, (what, at, how) in attacks:
            if when == turn:
                streams[not first] = tamper(streams[not first], streams[first], what, at, how)
        for receiver, stream in ((1, streams[0]), (0, streams[1])):
            for start in range(0, len(stream), step):
                ends[receiver].receive(stream[start : start + step], 0.0)
            for event in ends[receiver].events():
                if type(event) is Received:
                    assert event.key == KEY.format(f"r{1 - receiver}")
                    arrived[1 - receiver].append(event.payload)
    for whole, part in zip(sent, arrived, strict=True):
        assert part == whole[: len(part)]
    if not attacks:
        assert sent == arrived
        assert all(end.is_up for end in ends)


@given(st.integers(0, 60), st.integers(0, 7))
def test_any_flipped_bit_behind_the_handshake_ends_the_connection(at: int, bit: int) -> None:
    one, other = connected()
    one.queue.push(frames.SYNC, KEY.format("r0"), b"payload", latest=False)
    stream = bytearray(one.data_to_send(0.0, 4096))
    at %= len(stream)
    stream[at] ^= 1 << bit
    stream += bytes(70_000)  # a length that grew waits for these
    other.receive(bytes(stream), 0.0)
    assert other.state == "down"
    assert not [event for event in other.events() if type(event) is Received]


@given(st.binary(max_size=300))
def test_noise_behind_the_handshake_never_delivers(noise: bytes) -> None:
    _, other = connected()
    other.receive(noise + bytes(70_000), 0.0)
    assert other.state == "down"
    assert not [event for event in other.events() if type(event) is Received]


def test_a_recorded_connection_cannot_be_played_again() -> None:
    """Also not to the very session object's twin: same configuration, same robot, fresh nonce."""
    one, other = session("r0"), session("r1")
    record = one.data_to_send(0.0, 4096)
    other.receive(record, 0.0)
    one.receive(other.data_to_send(0.0, 4096), 0.0)
    one.queue.push(frames.SYNC, KEY.format("r0"), b"payload", latest=False)
    record += one.data_to_send(0.0, 4096)
    other.receive(record[len(D) :], 0.0)
    assert [type(event) for event in other.events()] == [LinkUp, Received]
    local = Local("r1", "lab", 5, False, {"r0": False}, frozenset(("r0", "r1")), keys=KEYS)
    counters: Counter[str] = Counter()
    clock = ClockSync(local.robot, local.incarnation, local.robots)
    again = Session(local, bytes(16), 0.0, dialled=None, admit=lambda *_: True, clock=clock, counters=counters)
    again.receive(record, 0.0)
    assert again.state == "down"
    assert counters == {"refused_key": 1}


def test_mac_and_size_of_confirm() -> None:
    assert frames.decode_confirm(bytes(32), 32) == bytes(32)
    for body, size in ((b"", 32), (bytes(31), 32), (bytes(32), 0)):
        with pytest.raises(FrameError, match="CONFIRM"):
            frames.decode_confirm(body, size)


def test_secrets_are_in_no_text() -> None:
    local = Local("r0", "lab", 1, False, {}, frozenset(), keys=KEYS)
    assert str(SECRET) not in repr(local)
    assert repr(SECRET)[2:20] not in repr(local)
