"""Fragments of a link: whatever is interleaved comes out whole, and a peer's memory is bounded."""

from collections import Counter
from contextlib import suppress

import pytest
from flow_world import MIB, Link, arrived
from hypothesis import given, settings
from hypothesis import strategies as st

from services.mesh.core.link import flow
from services.mesh.core.link.flow import Fragment, Reassembly, decode_ack, decode_fragment, encode_fragment
from services.mesh.core.link.outbox import Channels, Outbox, OutgoingPart
from services.mesh.core.wire.frames import BULK
from swarm.errors import FrameError


@given(st.integers(0, 1023), st.integers(0, 0x7FFF), st.booleans(), st.integers(1, MIB), st.binary(min_size=1))
def test_fragments_survive_encoding(channel: int, number: int, last: bool, total: int, data: bytes) -> None:
    fragment = Fragment(channel, number, last, 0 if number else total, data)
    assert decode_fragment(encode_fragment(fragment)[3:]) == fragment


@given(st.binary(max_size=40))
def test_any_bytes_raise_frame_errors_only(body: bytes) -> None:
    for decode in (decode_fragment, decode_ack):
        with suppress(FrameError):
            decode(body)


sizes = st.one_of(st.integers(0, 3000), st.integers(0, 100_000))


@settings(deadline=None)
@given(
    st.lists(st.tuples(st.sampled_from("abcde"), sizes), max_size=25),
    st.lists(st.sampled_from((100, flow.FRAGMENT, 488)), min_size=1, max_size=7),
)
def test_whatever_is_interleaved_comes_out_whole_and_in_the_order_of_its_key(
    messages: list[tuple[str, int]], cuts: list[int]
) -> None:
    outbox, channels, reassembly = Outbox(Counter()), Channels(), Reassembly(Counter())
    sent: dict[str, list[bytes]] = {}
    for number, (key, size) in enumerate(messages):
        payload = number.to_bytes(2, "little") + bytes(size)
        assert outbox.push(BULK, key, payload, latest=False)
        sent.setdefault(key, []).append(payload)
    received: dict[str, list[bytes]] = {}
    names: dict[int, str] = {}
    turn = 0
    while (item := outbox.pop(fragment=cuts[turn % len(cuts)])) is not None:
        turn += 1
        message = item.message if isinstance(item, OutgoingPart) else item
        channel, _ = channels.handle(message.key)
        names[channel] = message.key
        if isinstance(item, OutgoingPart):
            total = 0 if item.number else len(message.payload)
            frame = encode_fragment(Fragment(channel, item.number, item.last, total, item.data))
            whole = reassembly.add(decode_fragment(frame[3:]), turn * 0.01)
        else:
            whole = message.payload
        if whole is not None:
            received.setdefault(names[channel], []).append(whole)
    assert received == sent
    assert not reassembly._messages
    assert reassembly._bytes == 0
    assert outbox._begun == 0
    assert not outbox


wild = st.builds(
    Fragment,
    channel=st.integers(0, 80),
    number=st.sampled_from((0, 0, 1, 2)),
    last=st.booleans(),
    total=st.integers(1, MIB),
    data=st.binary(min_size=1, max_size=3),
)


@given(st.lists(st.tuples(wild, st.floats(0.0, 20.0)), max_size=200))
def test_whatever_a_peer_sends_its_memory_is_bounded(steps: list[tuple[Fragment, float]]) -> None:
    reassembly, now = Reassembly(Counter()), 0.0
    for fragment, wait in steps:
        now += wait
        with suppress(FrameError):
            reassembly.add(fragment, now)
        assert len(reassembly._messages) <= flow.MAX_INCOMPLETE
        assert (
            reassembly._bytes == sum(each.total for each in reassembly._messages.values()) <= flow.MAX_INCOMPLETE_BYTES
        )


def test_announced_bytes_count_not_only_those_that_came() -> None:
    counters: Counter[str] = Counter()
    reassembly = Reassembly(counters)
    for channel in range(3):
        reassembly.add(Fragment(channel, 0, False, MIB // 2, b"x"), 0.0)
    assert reassembly.add(Fragment(3, 0, False, 2, b"x"), 0.0) is None
    assert reassembly.add(Fragment(3, 1, True, 0, b"x"), 0.0) is None, "the rest of what was refused is passed over"
    assert counters == {"incomplete": 1}
    assert reassembly.add(Fragment(4, 0, False, 2, b"x"), 31.0) is None, "the others have timed out"
    assert counters == {"incomplete": 4}
    assert reassembly.add(Fragment(4, 1, True, 0, b"y"), 31.0) == b"xy"


@pytest.mark.parametrize(
    "second",
    [
        Fragment(0, 2, False, 0, b"gap"),
        Fragment(0, 1, False, 0, bytes(100)),
        Fragment(0, 1, True, 0, b"short"),
        Fragment(0, 1, False, 0, bytes(9)),
    ],
)
def test_a_sender_that_cannot_count_is_a_bad_one(second: Fragment) -> None:
    reassembly = Reassembly(Counter())
    reassembly.add(Fragment(0, 0, False, 10, b"x"), 0.0)
    with pytest.raises(FrameError, match="FRAGMENT"):
        reassembly.add(second, 0.0)


@pytest.mark.parametrize("total", [0, MIB + 1, 2**32 - 1])
def test_a_message_too_long_is_refused_at_its_first_fragment(total: int) -> None:
    body = b"\x00\x00\x00\x00" + total.to_bytes(4, "little") + b"x"
    with pytest.raises(FrameError, match=f"message of {total} bytes"):
        decode_fragment(body)


def test_a_message_begins_anew_when_its_key_lost_its_handle(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("services.mesh.core.link.session.Channels", lambda: Channels(size=2))
    link = Link(latency=0.001)
    payloads = {key: key.encode() * 6000 for key in "abcd"}
    for key, payload in payloads.items():
        link.send(link.a, BULK, key, payload)
    link.run(2.0)
    # With more large messages than handles none of them ends; once it is alone, one does.
    assert link.a.session.is_up
    assert link.b.session.is_up
    assert sum(bool(arrived(link.b, key)) for key in "abcd") + link.a.counters["overflowed"] < 4
    assert link.b.counters["incomplete"] > 0
