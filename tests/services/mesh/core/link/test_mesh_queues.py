"""Queues and handles of one connection: order, bounds, replacement."""

import random
from collections import Counter, defaultdict
from collections.abc import Iterable

import pytest
from hypothesis import given
from hypothesis import strategies as st
from mesh_world import World

from services.mesh.core.link.outbox import LIMITS, Channels, Outbox
from services.mesh.core.wire import frames
from services.mesh.core.wire.frames import BULK, CONTROL, HALTS, SYNC, FrameDecoder
from services.mesh.links.radio_model import AGAIN, FLOOR, PACKET, AirModel, DelayLine
from swarm.config.types import RelayRule
from swarm.errors import ConfigError

pushes = st.tuples(
    st.sampled_from((HALTS, CONTROL, SYNC, BULK)), st.sampled_from("abcd"), st.integers(0, 20_000), st.booleans()
)


def pop_all(outbox: Outbox) -> list[tuple[int, str, bytes]]:
    out = []
    while (message := outbox.pop(fragment=30_000)) is not None:
        out.append((message.priority, message.key, message.payload))
    return out


@given(st.lists(pushes, max_size=60), st.integers(0, 60))
def test_no_class_exceeds_its_bounds_and_every_message_is_accounted_for(
    steps: list[tuple[int, str, int, bool]], pop_every: int
) -> None:
    counters: Counter[str] = Counter()
    outbox, popped = Outbox(counters), 0
    for number, (priority, key, size, latest) in enumerate(steps):
        outbox.push(priority, f"{key}{priority}", bytes(size), latest)
        if pop_every and number % pop_every == 0:
            popped += outbox.pop(fragment=30_000) is not None
        bulk = [message for queue in outbox._bulk.values() for message in queue]
        control, sync, _, halts = outbox._urgent
        for each, queue in ((CONTROL, control), (SYNC, sync), (BULK, bulk), (HALTS, halts)):
            held = sum(message.size for message in queue)
            assert held == outbox._sizes[each] <= LIMITS[each].size
            assert len(queue) <= LIMITS[each].messages
        assert outbox.waiting == sum(map(len, (*outbox._urgent, *outbox._bulk.values())))
    popped += len(pop_all(outbox))
    assert popped + counters.total() == len(steps)
    assert not outbox
    assert not outbox._latest


@given(st.lists(st.tuples(st.sampled_from((HALTS, CONTROL, SYNC, BULK)), st.booleans()), max_size=50))
def test_the_most_urgent_leaves_first_and_each_class_keeps_its_order(steps: list[tuple[int, bool]]) -> None:
    outbox = Outbox(Counter())
    for number, (priority, _) in enumerate(steps):
        outbox.push(priority, str(number), b"", latest=False)
    out = pop_all(outbox)
    order = (HALTS, CONTROL, SYNC, BULK)
    assert out == sorted(out, key=lambda message: (order.index(message[0]), int(message[1])))
    assert len(out) == len(steps)


def test_many_small_messages_overflow_by_number_and_the_oldest_go() -> None:
    counters: Counter[str] = Counter()
    outbox = Outbox(counters)
    for number in range(LIMITS[SYNC].messages + 10):
        outbox.push(SYNC, str(number), b"", latest=False)
    assert counters == {"overflowed": 10}
    assert pop_all(outbox)[0][1] == "10"


def test_a_latest_value_keeps_its_place() -> None:
    counters: Counter[str] = Counter()
    outbox = Outbox(counters)
    for key, payload in (("a", b"1"), ("b", b"1"), ("a", b"22"), ("a", b"3")):
        outbox.push(BULK, key, payload, latest=True)
    assert pop_all(outbox) == [(BULK, "a", b"3"), (BULK, "b", b"1")]
    assert counters == {"replaced": 2}


@given(st.lists(st.integers(0, 12), max_size=200))
def test_a_handle_stands_for_the_key_it_was_last_bound_to(keys: list[int]) -> None:
    channels, bound = Channels(size=4), {}
    for number in keys:
        handle, new = channels.handle(f"key{number}")
        if new:
            bound[handle] = f"key{number}"
        assert 0 <= handle < 4
        assert bound[handle] == f"key{number}"


def test_a_key_in_use_keeps_its_handle() -> None:
    channels = Channels(size=2)
    assert channels.handle("often") == (0, True)
    for number in range(20):
        assert channels.handle("often") == (0, False)
        assert channels.handle(f"once{number}") == (1, True)


def test_more_keys_than_handles_still_arrive(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("services.mesh.core.link.session.Channels", lambda: Channels(size=3))
    world = World([("r0", "r1")], rules=[RelayRule("swarm/{self}/x/*", queue="all")])
    world.run(1.0)
    sent = [(f"swarm/r0/x/k{number % 7}", bytes((number,))) for number in range(100)]
    for key, payload in sent:
        world.publish("r0", key, payload)
    world.run(0.1)
    assert world.bots["r1"].inbox == sent


def test_an_urgent_message_overtakes_what_waits() -> None:
    rules = [RelayRule("swarm/{self}/bulk/*", queue="all"), RelayRule("swarm/{self}/sync/*", priority="sync")]
    world = World([("r0", "r1")], rules=rules)
    world.run(1.0)
    (session,) = world.bots["r0"].ends
    node = world.bots["r0"].node
    for number in range(20):
        node.publish(0, f"swarm/r0/bulk/k{number}", bytes(1000), world.now)
    node.publish(1, "swarm/r0/sync/k", b"now", world.now)
    first, second, *_ = FrameDecoder(frames.MAX_FRAME).frames(session.data_to_send(world.now, 100))
    assert first.kind == frames.BIND
    assert frames.decode_data(second.body)[1] == b"now"


def test_a_message_that_no_frame_holds_is_counted_and_named_once() -> None:
    world = World([("r0", "r1")], rules=[RelayRule("swarm/{self}/x/*", priority="sync", queue="all")])
    world.run(1.0)
    for _ in range(3):
        world.publish("r0", "swarm/r0/x/big", bytes(frames.MAX_PAYLOAD + 1))
    world.publish("r0", "swarm/r0/x/fits", bytes(frames.MAX_PAYLOAD))
    world.run(0.1)
    bot = world.bots["r0"]
    assert bot.counters["too_large"] == 3
    assert sum("4086 bytes, the mesh carries at most 4085 in its class" in note.text for note in bot.notes) == 1
    assert [key for key, _ in world.bots["r1"].inbox] == ["swarm/r0/x/fits"]


# -- the simulated radio --


def arrivals(line: DelayLine) -> list[tuple[float, bytes]]:
    out = []
    while (arrival := line.next_arrival()) is not None:
        out.append((arrival, line.pop()))
    return out


class Drawn:
    """Numbers that were drawn before."""

    def __init__(self, *, deviates: Iterable[float] = (), uniform: Iterable[float] = ()) -> None:
        self._deviates, self._uniform = iter(deviates), iter(uniform)

    def gauss(self, mean: float, _: float) -> float:
        return mean + next(self._deviates)

    def random(self) -> float:
        return next(self._uniform)


def test_latency_alone_delays_each_message_by_the_same_time() -> None:
    line = DelayLine(AirModel(latency=0.03), Drawn())
    line.push(b"a", 1.0)
    line.push(b"bb", 1.001)
    assert arrivals(line) == [(1.03, b"a"), (1.031, b"bb")]


def test_bandwidth_queues_behind_earlier_bytes() -> None:
    line = DelayLine(AirModel(latency=0.03, bandwidth=1000.0), None)
    line.push(bytes(100), 1.0)
    line.push(bytes(50), 1.01)
    line.push(bytes(10), 2.0)
    assert [time for time, _ in arrivals(line)] == pytest.approx([1.13, 1.18, 2.04])
    assert line.free_at == pytest.approx(2.01)


@given(st.lists(st.tuples(st.floats(0.0, 0.1), st.floats(-0.1, 0.2)), max_size=50))
def test_jitter_keeps_order_and_floor(steps: list[tuple[float, float]]) -> None:
    line = DelayLine(AirModel(latency=0.03, jitter=0.01), Drawn(deviates=[deviate for _, deviate in steps]))
    now, stamps = 1.0, []
    for number, (gap, _) in enumerate(steps):
        now += gap
        stamps.append(now)
        line.push(bytes((number,)), now)
    out = arrivals(line)
    assert [data for _, data in out] == [bytes((number,)) for number in range(len(steps))]
    times = defaultdict(float, enumerate(time for time, _ in out))
    for number, stamp in enumerate(stamps):
        assert times[number] >= stamp + FLOOR - 1e-9
        assert times[number] >= times[number - 1]


def test_what_is_lost_comes_again_later() -> None:
    """Each packet of its own: with a loss of one half it is lost as often as 1 - u falls short of 1/2, 1/4, ..."""
    line = DelayLine(AirModel(latency=0.03, loss=0.5), Drawn(uniform=[0.0, 0.6, 0.3, 0.9]))
    line.push(bytes(PACKET), 1.0)
    line.push(bytes(PACKET), 2.0)
    line.push(bytes(PACKET + 1), 3.0)
    assert [time for time, _ in arrivals(line)] == pytest.approx([1.03, 2.03 + AGAIN, 3.03 + 3 * AGAIN])


def test_packets_that_are_sent_again_hold_up_those_behind_them() -> None:
    line = DelayLine(AirModel(latency=0.03, bandwidth=1000.0, loss=0.5), Drawn(uniform=[0.9, 0.0]))
    line.push(bytes(100), 1.0)
    line.push(bytes(100), 1.0)
    assert [time for time, _ in arrivals(line)] == pytest.approx([1.13 + 3 * AGAIN, 1.23 + 3 * AGAIN])


@given(st.floats(0.01, 0.8), st.integers(0, 5))
def test_so_many_packets_are_lost_as_the_model_says(loss: float, seed: int) -> None:
    line, n = DelayLine(AirModel(loss=loss), random.Random(seed)), 2000
    for number in range(n):
        line.push(b"x", float(number))
    lost = sum(time - stamp for stamp, (time, _) in enumerate(arrivals(line))) / AGAIN / n
    deviation = loss**0.5 / (1 - loss)
    assert lost == pytest.approx(loss / (1 - loss), abs=5 * deviation / n**0.5)


def test_air_models_are_read_from_text() -> None:
    assert AirModel.parse("") == AirModel()
    assert AirModel.parse("latency=0.03,jitter=0.01,bandwidth=78000,seed=5") == AirModel(0.03, 0.01, 78000.0, 5)
    assert AirModel.parse("dial=2").dial == 2.0
    assert AirModel.parse("loss=0.1").loss == 0.1
    for wrong in (
        "latency",
        "latency=x",
        "speed=3",
        "jitter=-1",
        "bandwidth=0",
        "latency=nan",
        "latency=inf",
        "loss=1",
    ):
        with pytest.raises(ConfigError, match="SWARM_SIM_LINK"):
            AirModel.parse(wrong)
