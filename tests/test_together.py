"""Several keys' messages in one, and slow copies of fast keys."""

from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from swarm.bus import batch
from swarm.bus.throttle import GATHERED_BYTES, GATHERED_S, Gathering, Slow
from swarm.errors import PayloadError
from swarm.messages import Clock, Gathered, Pose
from swarm.messages.codec import MAX_PAYLOAD, encode
from swarm.recording.recorded_topics import Watch

keys = st.text(st.characters(min_codepoint=33, max_codepoint=126), max_size=255)


def test_golden_bytes() -> None:
    assert batch.pack([("ab", b"\x01\x02"), ("c", b"")]) == bytes.fromhex("02 02000000 6162 0102 01 00000000 63")
    assert list(batch.unpack(b"")) == []


@given(st.lists(st.tuples(keys, st.binary(max_size=300)), max_size=8))
def test_parts_come_back(parts: list[tuple[str, bytes]]) -> None:
    assert list(batch.unpack(batch.pack(parts))) == parts


@given(st.lists(st.tuples(keys, st.binary(max_size=30)), min_size=1, max_size=4), st.data())
def test_what_is_cut_short_is_refused(parts: list[tuple[str, bytes]], data: st.DataObject) -> None:
    whole = batch.pack(parts)
    ends = {len(batch.pack(parts[:count])) for count in range(len(parts))}
    size = data.draw(st.integers(0, len(whole) - 1).filter(lambda size: size not in ends))
    with pytest.raises(PayloadError):
        list(batch.unpack(whole[:size]))


@given(st.binary(max_size=200))
def test_any_bytes_are_parts_or_refused(noise: bytes) -> None:
    try:
        parts = list(batch.unpack(noise))
    except PayloadError:
        return
    assert batch.pack(parts) == noise


class Notes:
    """What was published."""

    def __init__(self) -> None:
        self.told: list[tuple[str, object]] = []

    def publish(self, key: str, message: object, *, urgent: bool = False) -> None:
        self.told.append((key, message))


def test_a_slow_copy_keeps_its_rate_whatever_the_fast_one_is() -> None:
    bus = Notes()
    slow = Slow(bus, "swarm/r0/balancer/state", 0.2)  # type: ignore[arg-type]
    for tick in range(251):  # 25 Hz, and after 5 s a second of silence
        slow.publish(tick, 100.0 + 0.04 * tick + (1.0 if tick > 125 else 0.0))
    assert {key for key, _ in bus.told} == {"swarm/r0/balancer/state/slow"}
    assert 50 <= len(bus.told) <= 52
    gaps = [b - a for (_, a), (_, b) in zip(bus.told, bus.told[1:], strict=False)]  # type: ignore[operator]
    assert set(gaps) <= {1, 4, 5, 6}
    assert gaps.count(5) >= 40


def test_news_do_not_wait() -> None:
    bus = Notes()
    slow = Slow(bus, "k", 0.2)  # type: ignore[arg-type]
    for t, news in ((0.0, False), (0.04, True), (0.08, False), (0.2, False), (0.24, False), (0.4, False)):
        slow.publish(t, t, news=news)
    assert [message for _, message in bus.told] == [0.0, 0.04, 0.2, 0.4]


class Wire(Notes):
    """A bus whose messages its own subscriber hears, where it hears them."""

    def __init__(self) -> None:
        super().__init__()
        self.heard: dict[str, Callable[[str, bytes], None]] = {}

    def wanted(self, key: str) -> bool:
        return key in self.heard

    def subscribe(self, keys: list[str], callback: Callable[[str, bytes], None]) -> None:
        self.heard |= dict.fromkeys(keys, callback)

    def publish(self, key: str, message: object, *, urgent: bool = False) -> None:
        super().publish(key, message)
        if key in self.heard:
            self.heard[key](key, message if isinstance(message, bytes) else encode(message))


class Sink:
    """What was recorded."""

    def __init__(self) -> None:
        self.taken: list[tuple[str, float, object]] = []

    def write(self, topic: str, t: float, message: object, name: str = "") -> None:
        self.taken.append((topic, t, message))


def test_what_is_gathered_is_recorded_one_by_one() -> None:
    bus, sink = Wire(), Sink()
    poses = Gathering(bus, "swarm/r0/dwm/pose")  # type: ignore[arg-type]
    sent = [Pose(0.1 * k, k, 0.5 * k, 0.0, None, 90, "ekf") for k in range(11)]
    poses.add(sent[0], sent[0].t)
    assert bus.told == [], "nobody hears it"
    watch = Watch(bus, "r0", "x", sink, lambda: 9.0)  # type: ignore[arg-type]
    assert "swarm/r0/dwm/pose" not in bus.heard
    for pose in sent[1:]:
        poses.add(pose, pose.t)
    watch.drain()
    assert len(bus.told) == 1 + int(0.9 / GATHERED_S)
    assert sink.taken == [("swarm/r0/dwm/pose", pose.t, pose) for pose in sent[1:10]]
    poses.flush()
    poses.flush()
    watch.drain()
    assert sink.taken[9:] == [("swarm/r0/dwm/pose", 1.0, sent[10])]


@given(st.lists(st.integers(0, 20_000), max_size=40), st.floats(0.0, 0.1))
def test_a_gathered_message_is_bounded_in_size_and_loses_nothing(sizes: list[int], gap: float) -> None:
    bus = Wire()
    bus.subscribe(["k/gathered"], lambda *_: None)
    gathering = Gathering(bus, "k")  # type: ignore[arg-type]
    sent = [Gathered((bytes(size),)) for size in sizes]
    for index, message in enumerate(sent):
        gathering.add(message, gap * index)
    gathering.flush()
    told = [message for _, message in bus.told]
    assert all(len(encode(message)) <= GATHERED_BYTES + 100 for message in told)
    assert [part for message in told for part in message.messages] == list(map(encode, sent))


def test_a_message_that_cannot_be_packed_is_not_gathered() -> None:
    bus = Wire()
    bus.subscribe(["k/gathered"], lambda *_: None)
    gathering = Gathering(bus, "k")  # type: ignore[arg-type]
    gathering.add(Gathered((bytes(MAX_PAYLOAD),)), 0.0)
    assert bus.told == []


def test_what_was_not_gathered_is_not_recorded() -> None:
    bus, sink = Wire(), Sink()
    watch = Watch(bus, "r0", "x", sink, lambda: 9.0)  # type: ignore[arg-type]
    whole = encode(Gathered((b"", encode(Clock(1.0, 0.0, 0.0, "r0", 0, 0.0)))))
    for noise in (b"noise", whole):
        bus.publish("swarm/r0/dwm/pose/gathered", noise)
    watch.drain()
    assert sink.taken == []
