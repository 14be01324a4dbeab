"""What waits to be recorded has a limit, however much a robot's services and other robots' apps say."""

from collections.abc import Callable, Sequence
from functools import partial

from swarm.messages import BalancerState, Leds
from swarm.messages.codec import MAX_PAYLOAD, encode
from swarm.recording.recorded_topics import MAX_BYTES, MAX_WAITING, TOPICS, TopicRecorder

LEDS = "swarm/r0/balancer/leds"
FLOOD = "swarm/r1/app/x/flood"


class Bus:
    """Gives every sample to every callback that has subscribed to its key, or to a pattern."""

    def __init__(self) -> None:
        self.callbacks: list[Callable[[str, bytes], None]] = []

    def subscribe(self, keys: Sequence[str], callback: Callable[[str, bytes], None]) -> None:
        self.callbacks.append(callback)

    def bring(self, key: str, payload: bytes) -> None:
        self.callbacks[0](key, payload)


class Sink:
    """Stands for the recording."""

    def __init__(self) -> None:
        self.written: list[tuple[str, object]] = []

    def write(self, topic: str, t: float, message: object, name: str = "") -> None:
        self.written.append((topic, message))


def rig() -> tuple[Bus, Sink, TopicRecorder, list[int]]:
    bus, sink, lost = Bus(), Sink(), list[int]()
    recorder = TopicRecorder(bus, "r0", "x", sink, lambda: 1.0)  # type: ignore[arg-type]  # no more than it needs
    recorder.on_lost = lost.append
    return bus, sink, recorder, lost


def _last(times: Sequence[float]) -> float:
    return times[-1]


def test_of_large_messages_the_oldest_are_lost_and_counted() -> None:
    bus, sink, recorder, lost = rig()
    most = MAX_BYTES // (MAX_PAYLOAD + len(LEDS))
    for _ in range(most + 10):
        bus.bring(LEDS, bytes(MAX_PAYLOAD))
    assert sum(lost) == 10
    bus.bring(LEDS, encode(Leds(2.0, red=True, yellow=False, green=False)))
    assert recorder._bytes <= MAX_BYTES
    recorder.drain()
    assert [topic for topic, _ in sink.written] == [LEDS]
    assert recorder._bytes == 0


def test_of_many_messages_the_oldest_are_lost_and_counted() -> None:
    bus, sink, recorder, lost = rig()
    for number in range(MAX_WAITING + 10):
        bus.bring(LEDS, encode(Leds(float(number), red=True, yellow=False, green=False)))
    recorder.drain()
    assert (len(sink.written), sum(lost)) == (MAX_WAITING, 10)
    assert sink.written[0][1] == Leds(10.0, red=True, yellow=False, green=False)


def test_what_is_too_large_for_a_message_takes_no_room_from_others() -> None:
    bus, sink, recorder, lost = rig()
    bus.bring(LEDS, encode(Leds(1.0, red=True, yellow=False, green=False)))
    bus.bring(LEDS, bytes(MAX_BYTES))
    recorder.drain()
    assert (len(sink.written), lost) == (1, [])


def test_of_large_floods_only_the_size_waits() -> None:
    bus, sink, recorder, lost = rig()
    for _ in range(10):
        bus.bring(FLOOD, bytes(960_000))
    recorder.drain()
    assert lost == []
    assert [message["size"] for _, message in sink.written] == [960_000] * 10  # type: ignore[index]


def test_ever_new_senders_are_not_remembered() -> None:
    bus, _, recorder, _ = rig()
    for number in range(100):
        bus.bring(f"swarm/n{number}/app/x/flood", b"")
    recorder.drain()
    assert recorder._due == {}


def test_a_key_is_thinned_out_to_its_rate_whatever_its_own_is() -> None:
    """0.2 s is a multiple of 0.04 s, and 0.15 s is none. News come beside the throttled copy's own messages."""
    for period in (0.04, 0.05, 0.11, 0.2):
        bus, sink, times = Bus(), Sink(), [0.0]
        recorder = TopicRecorder(bus, "r0", "x", sink, partial(_last, times))  # type: ignore[arg-type]
        while times[-1] < 20.0:
            state = BalancerState(times[-1], "idle", *[0.0] * 6, 0, 0.0, 0.0, "")
            bus.bring("swarm/r0/balancer/state/throttled", encode(state))
            times.append(times[-1] + period)
        recorder.drain()
        assert 90 <= len(sink.written) <= 20.0 / TOPICS["balancer/state"] + 2, period
