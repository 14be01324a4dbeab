"""Virtual links are byte pipes: what arrives is what was sent, in order, not before its time; cuts hold it back."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.mesh.links.radio_model import FLOOR, AirModel
from sim.virtual.events import EventQueue
from sim.virtual.radio.air import SOCKET, Air


class FakeSession:
    """Gives out what it is told to, as `Session.data_to_send` does."""

    def __init__(self):
        self.waiting = []
        self.queue = self

    @property
    def bulk_waits(self):
        return bool(self.waiting)

    def data_to_send(self, now, max_bytes):
        return self.waiting.pop(0) if self.waiting else b""


class FakeStation:
    def __init__(self, robot, time, air):
        self.robot, self.time, self.running = robot, time, True
        self.session, self.end, self.heard, self.failed, self.down = FakeSession(), None, [], [], []
        air.add(self)

    def _take(self, end):
        self.end, end.session = end, self.session

    def dialled(self, peer, end):
        self._take(end)

    accepted = _take

    def flushed(self, session):
        pass

    def dial_failed(self, peer, reason):
        self.failed.append((self.time.now, peer))

    def received(self, arrivals):
        for _, data in arrivals:
            if isinstance(data, bytes):
                self.heard.append((self.time.now, data))
            else:
                self.down.append(self.time.now)


class Pair:
    def __init__(self, **model):
        self.time = EventQueue()
        self.air = Air(self.time, AirModel(**model))
        self.r0, self.r1 = (FakeStation(name, self.time, self.air) for name in ("r0", "r1"))
        self.air.dial(self.r0, "r1")
        self.time.run(self.time.now)

    def send(self, data, station=None):
        station = station or self.r0
        station.session.waiting.append(data)
        self.air.flush(station.end)


WRITES = st.lists(st.tuples(st.floats(0.0, 0.5), st.binary(min_size=1, max_size=900)), max_size=20)
MODELS = st.fixed_dictionaries(
    {
        "latency": st.sampled_from((0.0, 0.03)),
        "jitter": st.sampled_from((0.0, 0.01)),
        "bandwidth": st.sampled_from((None, 5000.0, 78000.0)),
        "seed": st.integers(0, 3),
    }
)
CUTS = st.lists(st.tuples(st.floats(0.0, 3.0), st.floats(0.0, 2.0)), max_size=4)


@given(WRITES, MODELS, CUTS)
def test_everything_arrives_once_in_order_and_not_too_early(writes, model, cuts):
    pair = Pair(**model)
    sent, at = [], 0.0
    for at_cut, seconds in cuts:
        pair.time.at(at_cut, pair.air.cut, "r0", "r1", seconds)
    for gap, data in writes:
        at += gap
        sent.append((at, data))
        pair.time.at(at, pair.send, data)
    pair.time.run()
    assert [data for _, data in pair.r1.heard] == [data for _, data in sent]
    least = min(model["latency"], FLOOR) if model["jitter"] else model["latency"]
    for (left, data), (came, _) in zip(sent, pair.r1.heard, strict=True):
        air = len(data) / model["bandwidth"] if model["bandwidth"] else 0.0
        assert came >= left + air + least - 1e-9
        assert not any(start <= came < start + seconds for start, seconds in cuts)


@given(WRITES, MODELS)
def test_the_same_seed_gives_the_same_times(writes, model):
    def times():
        pair, at = Pair(**model), 0.0
        for gap, data in writes:
            at += gap
            pair.time.at(at, pair.send, data)
        pair.time.run()
        return pair.r1.heard

    assert times() == times()


def test_the_bandwidth_fills_the_socket_and_then_holds_the_session_back():
    pair = Pair(bandwidth=10_000.0)
    for _ in range(100):
        pair.r0.session.waiting.append(bytes(1000))
    pair.air.flush(pair.r0.end)
    assert 0 < 1000 * len(pair.r0.session.waiting) <= 100_000 - SOCKET
    pair.time.run()
    assert pair.r1.heard[-1][0] == pytest.approx(10.0)
    assert len(pair.r1.heard) == 100


def test_a_closed_end_is_noticed_after_what_was_sent_before():
    pair = Pair(latency=0.03)
    pair.send(b"last words")
    pair.air.close(pair.r0.end)
    pair.send(b"too late", pair.r1)
    pair.time.run()
    assert pair.r1.heard == [(0.03, b"last words")]
    assert pair.r1.down == [0.03]
    assert pair.r0.heard == []


def test_there_is_no_connection_through_a_cut_nor_with_nobody():
    pair = Pair()
    pair.air.cut("r0", "r1", 1.0)
    pair.air.dial(pair.r0, "r1")
    pair.air.dial(pair.r0, "r9")
    pair.time.run()
    assert pair.r0.failed == [(0.0, "r1"), (0.0, "r9")]
    pair.time.run(2.0)
    pair.air.dial(pair.r0, "r1")
    pair.time.run()
    assert len(pair.r0.failed) == 2
