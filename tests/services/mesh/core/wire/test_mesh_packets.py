"""Packets of the overlays: golden bytes of docs/reference/network/overlay-packets.md, round trips, and whatever bytes a
member may send."""

import re
import struct
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.mesh.core.bulk import pieces
from services.mesh.core.bulk.numbered import SeenNumbers
from services.mesh.core.bulk.pieces import DONE, GONE, OFFER, PIECE, STATE, WANT, MessageId, Packet
from services.mesh.core.overlays import carried, completion, stop
from services.mesh.core.overlays.carried import Carried
from services.mesh.core.overlays.completion import Known
from services.mesh.core.overlays.stop import Halt, Mark
from services.mesh.core.routing import topology
from services.mesh.core.routing.topology import Advertisement
from services.mesh.core.wire import packets
from services.mesh.core.wire.frames import MAX_PAYLOAD
from services.mesh.core.wire.packets import Ack, EchoPacket, Spread, UnicastMessage
from swarm.errors import FrameError
from swarm.messages.service import MAX_REASON

DOCUMENT = Path(__file__).parents[5] / "docs/reference/network/overlay-packets.md"

LARGE = MessageId("r0", 1, 5, flood=False)

GOLDEN = {
    "spread": packets.encode_spread(Spread(0x0006_0000_0000_0001, 7, b"hi", latest=True)),
    "second": packets.encode_spread(Spread(0x0006_0000_0000_0001, 9, b"hi", echo=True, first=7)),
    "all_know": packets.encode_spread(Spread(0x0006_0000_0000_0001, 7, b"hi", known=0b11)),
    "known": completion.encode_known(Known(0x0006_0000_0000_0001, 7, 0b1111)),
    "echo": packets.encode_echo(EchoPacket(0x0006_0000_0000_0001, 7, ("r1", "r2"))),
    "digest": packets.encode_digests({"r0": (1, 0xAABBCCDD)}, answer=True)[0],
    "summary": packets.encode_summary(0xAABBCCDD),
    "halt": stop.encode_halts(Halt({"r2": (Mark(1, 1), "smoke")}, {}))[0],
    "arm": stop.encode_halts(Halt({}, {"r2": Mark(1, 1)}))[0],
    "lsa": topology.encode_advertisement(Advertisement({"r1": 300, "r2": 291})),
    "message": packets.encode_message(UnicastMessage("r0", "r3", 1, 5, "swarm/r0/app/x/send/r3", b"hi", 32)),
    "ack": packets.encode_ack(Ack("r3", "r0", 1, 5, refused=False, ttl=32)),
    "announce": packets.encode_spread(Spread(0x0006_0000_0000_0001, 7, b"", echo=True, size=1_000_000)),
    "offer": pieces.encode(Packet(OFFER, "r0", "r3", LARGE, pieces.encode_offer(5000, "swarm/r0/app/x/send/r3"), 32)),
    "want": pieces.encode(Packet(WANT, "r3", "r0", LARGE, pieces.encode_want(0, (0, 1, 2)), 32)),
    "piece": pieces.encode(Packet(PIECE, "r0", "r3", LARGE, pieces.encode_piece(2, b"abc"), 32)),
    "state": pieces.encode(Packet(STATE, "r3", "r0", LARGE, pieces.encode_state(DONE), 32)),
    "gone": pieces.encode(Packet(GONE, "r1", "r2", MessageId("r0", 1, 7, flood=True), b"", 32)),
    "avoiding": packets.encode_message(UnicastMessage("r0", "r1", 1, 0, "swarm/r0/app/x/sync/c/r1/around", b"hi", 32)),
    "carry": carried.encode_carried(Carried(0b1010, b"hi", 32)),
}

DECODERS: dict[str, Callable[[bytes], object]] = {
    "spread": packets.decode_spread,
    "second": packets.decode_spread,
    "all_know": packets.decode_spread,
    "known": completion.decode_known,
    "echo": packets.decode_echo,
    "digest": packets.decode_digest,
    "summary": packets.decode_summary,
    "halt": stop.decode_halt,
    "arm": stop.decode_halt,
    "lsa": topology.decode_advertisement,
    "message": packets.decode_message,
    "ack": packets.decode_ack,
    "announce": packets.decode_spread,
    "offer": lambda data: pieces.decode_offer(pieces.decode(data).body),
    "want": lambda data: pieces.decode_want(pieces.decode(data).body),
    "piece": lambda data: pieces.decode_piece(pieces.decode(data).body),
    "state": lambda data: pieces.decode_state(pieces.decode(data).body),
    "gone": pieces.decode,
    "avoiding": packets.decode_message,
    "carry": carried.decode_carried,
}


@pytest.mark.parametrize("name", GOLDEN)
def test_the_bytes_are_those_of_the_document(name: str) -> None:
    (line,) = re.findall(rf"^{name} +((?:[0-9a-f]{{2}} ?)+)$", DOCUMENT.read_text(), re.MULTILINE)
    assert GOLDEN[name] == bytes.fromhex(line)


names = st.from_regex(r"[a-z][a-z0-9_-]{0,15}", fullmatch=True)
u64 = st.integers(0, 2**64 - 1)
u32 = st.integers(1, 2**32 - 1)
none, below_9 = st.just(0), st.integers(1, 8)
large = st.integers(packets.MAX_SPREAD + 1, packets.MAX_MESSAGE)
large_known = st.integers(packets.room(all_know=True) + 1, packets.MAX_MESSAGE)
bits = st.integers(1, 2**2040 - 1)
keys = st.sampled_from(("swarm/r0/app/x/send/r3", "swarm/r3/balancer/set/mode"))


def spreads_with(**fields: st.SearchStrategy[object]) -> st.SearchStrategy[Spread]:
    plain = {name: st.just(value) for name, value in Spread(1, 9, b"")._asdict().items()}
    return st.builds(Spread, **{**plain, "incarnation": u64, **fields})


spreads = st.one_of(
    spreads_with(sequence=u32, payload=st.binary(max_size=99), echo=st.booleans()),
    spreads_with(sequence=u32, payload=st.binary(max_size=99), latest=st.just(True)),
    spreads_with(payload=st.binary(max_size=9), echo=st.booleans(), first=below_9),
    spreads_with(echo=st.just(True), first=below_9, size=large),
    spreads_with(sequence=u32, latest=st.booleans(), size=large),
    spreads_with(payload=st.binary(max_size=99), first=none | below_9, known=bits),
    spreads_with(first=none | below_9, known=bits, size=large_known),
)


@given(spreads)
def test_a_spread_packet_survives_encoding(packet: Spread) -> None:
    assert packets.decode_spread(packets.encode_spread(packet)) == packet


@given(st.builds(EchoPacket, u64, u32, st.lists(names, max_size=30).map(tuple), st.booleans(), st.booleans(),
                 st.integers(0, 255)))  # fmt: skip
def test_an_echo_packet_survives_encoding(packet: EchoPacket) -> None:
    assert packets.decode_echo(packets.encode_echo(packet)) == packet


def test_an_echo_that_does_not_fit_says_so() -> None:
    robots = tuple(f"robot-number-{n}" for n in range(1000))
    data = packets.encode_echo(EchoPacket(1, 1, robots))
    assert len(data) <= MAX_PAYLOAD
    echo = packets.decode_echo(data)
    assert echo.lost
    assert 0 < len(echo.robots) < 1000


@given(st.builds(Known, u64, u32, st.integers(0, 2**2040 - 1), st.booleans()))
def test_a_known_packet_survives_encoding(packet: Known) -> None:
    assert completion.decode_known(completion.encode_known(packet)) == packet


def test_the_longest_flood_fits_a_packet_with_all_robots_that_it_can_name() -> None:
    payload = bytes(packets.room(all_know=True))
    assert len(packets.encode_spread(Spread(1, 9, payload, first=1, known=2**2040 - 1))) == MAX_PAYLOAD


@given(st.dictionaries(names, st.tuples(u64, st.integers(0, 2**32 - 1)), max_size=120), st.booleans())
def test_digests_cover_every_name_once(origins: dict[str, tuple[int, int]], answer: bool) -> None:
    parts = [packets.decode_digest(data) for data in packets.encode_digests(origins, answer=answer)]
    assert {name: entry for part in parts for name, entry in part.origins.items()} == origins
    assert parts[0].low == ""
    assert parts[-1].high == ""
    assert [part.high for part in parts[:-1]] == [part.low for part in parts[1:]]
    for part in parts:
        assert all(part.low < name and (not part.high or name <= part.high) for name in part.origins)


marks = st.builds(Mark, u64, st.integers(0, 2**32 - 1))
halts = st.builds(
    Halt,
    st.dictionaries(names, st.tuples(marks, st.text(max_size=16)), max_size=50),
    st.dictionaries(names, marks, max_size=50),
)


@given(halts)
def test_a_halt_packet_survives_encoding(halt: Halt) -> None:
    merged = Halt({}, {})
    for data in stop.encode_halts(halt):
        assert len(data) <= MAX_PAYLOAD
        part = stop.decode_halt(data)
        merged.stops.update(part.stops)
        merged.arms.update(part.arms)
    assert merged == halt


@given(halts, st.binary(min_size=1, max_size=40))
def test_a_stop_counts_whatever_follows_it_and_a_re_arm_only_in_a_packet_that_is_understood(
    halt: Halt, more: bytes
) -> None:
    stops: dict[str, tuple[Mark, str]] = {}
    for data in stop.encode_halts(halt):
        try:
            part = stop.decode_halt(data + more)
        except FrameError:
            assert not stop.decode_halt(data).stops
        else:
            assert part.arms == {}
            stops |= part.stops
    assert stops == halt.stops


def test_a_stop_counts_in_a_packet_that_is_cut_off_and_with_a_text_of_another_release() -> None:
    mark = Mark(1, 1)
    two = stop.encode_halts(Halt({"r1": (mark, "a"), "r2": (mark, "b")}, {}))[0]
    for end in range(3, len(two)):
        try:
            found = stop.decode_halt(two[:end]).stops
        except FrameError:
            found = {}
        assert found in ({}, {"r1": (mark, "a")})
    whole = bytes((packets.HALT, 1, 0)) + b"\x02r1" + struct.pack("<QI", 1, 1)
    for text in (b"\xff\xfe", b"x" * 200, "\u00e4".encode() * 100):
        ((_, reason),) = stop.decode_halt(whole + bytes((len(text),)) + text).stops.values()
        assert len(reason.encode()) <= MAX_REASON


@given(
    st.builds(
        Advertisement,
        neighbours=st.dictionaries(names, st.integers(0, 65535), max_size=20),
        leaving=st.booleans(),
        topology=u32,
        heard=st.integers(0, 2**100),
        process=st.just(0) | u32,
        twins=st.lists(names, unique=True, max_size=topology.MAX_TWINS).map(tuple),
    )
)
def test_a_link_state_survives_encoding(packet: Advertisement) -> None:
    assert topology.decode_advertisement(topology.encode_advertisement(packet)) == packet


@given(
    st.builds(UnicastMessage, names, names, u64, st.just(0) | u32, keys, st.binary(max_size=99), st.integers(0, 255))
)
def test_a_message_packet_survives_encoding(packet: UnicastMessage) -> None:
    assert packets.decode_message(packets.encode_message(packet)) == packet


@given(st.builds(Carried, st.integers(0, 2**2040 - 1), st.binary(max_size=99), st.integers(0, 255), st.booleans()))
def test_a_carry_packet_survives_encoding(packet: Carried) -> None:
    assert carried.decode_carried(carried.encode_carried(packet)) == packet


@given(st.builds(Ack, names, names, u64, u32, st.booleans(), st.integers(0, 255)))
def test_an_ack_packet_survives_encoding(packet: Ack) -> None:
    assert packets.decode_ack(packets.encode_ack(packet)) == packet


@given(
    st.integers(OFFER, GONE), names, names, names, u64, u32, st.binary(max_size=99), st.integers(0, 255), st.booleans()
)
def test_packets_of_large_messages_survive_encoding(
    kind: int, sender: str, to: str, origin: str, incarnation: int, number: int, body: bytes, ttl: int, flood: bool
) -> None:
    flood = flood and kind not in (OFFER, STATE)  # a flood is announced by a SPREAD
    offers = to if kind in (WANT, STATE) else sender
    packet = Packet(kind, sender, to, MessageId(origin if flood else offers, incarnation, number, flood), body, ttl)
    data = pieces.encode(packet)
    assert pieces.decode(data) == packet
    if ttl:
        assert pieces.decode(pieces.passed_on(data)) == packet._replace(ttl=ttl - 1)


@given(st.lists(st.integers(0, 600), max_size=pieces.MAX_RANGES, unique=True), st.integers(0, 65535))
def test_a_want_packet_survives_encoding(indexes: list[int], have: int) -> None:
    assert pieces.decode_want(pieces.encode_want(have, indexes)) == pieces.WantBody(have, tuple(indexes))


def test_a_want_of_too_many_pieces_is_refused() -> None:
    body = pieces.encode_want(0, range(pieces.MAX_WANTED + 1))
    with pytest.raises(FrameError, match="more than"):
        pieces.decode_want(body)
    with pytest.raises(FrameError, match="runs"):
        pieces.decode_want(b"\0\0\xff")


@given(st.binary(max_size=200), st.sampled_from(sorted(DECODERS)))
def test_any_bytes_raise_frame_errors_only(data: bytes, name: str) -> None:
    with suppress(FrameError):
        DECODERS[name](GOLDEN[name][:1] + data)
    with suppress(FrameError):
        DECODERS[name](data)


@given(st.sampled_from(sorted(DECODERS)), st.data())
def test_mutated_packets_raise_frame_errors_only(name: str, data: st.DataObject) -> None:
    mutated = bytearray(GOLDEN[name])
    for _ in range(data.draw(st.integers(1, 4))):
        mutated[data.draw(st.integers(0, len(mutated) - 1))] = data.draw(st.integers(0, 255))
    cut = data.draw(st.integers(0, len(mutated)))
    for candidate in (bytes(mutated), bytes(mutated[:cut]), bytes(mutated) + b"\0"):
        with suppress(FrameError):
            DECODERS[name](candidate)


def test_the_header_of_a_flood_is_short() -> None:
    assert len(packets.encode_spread(Spread(1, 1, b""))) == 14


@given(st.lists(st.integers(1, 400)), st.sampled_from((8, 64, 256)))
def test_a_window_takes_each_number_at_most_once(numbers: list[int], size: int) -> None:
    window, taken, highest = SeenNumbers(size), set(), 0
    for number in numbers:
        expected = number not in taken and number > highest - size
        assert window.add(number) is expected
        highest = max(highest, number)
        taken.add(number)
    assert window._bits < 1 << size
