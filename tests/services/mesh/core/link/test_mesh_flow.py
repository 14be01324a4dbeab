"""Flow on one link: acknowledged bytes, the window, shares of the classes, and pushing back."""

import random
import statistics
from collections import Counter
from typing import cast

import pytest
from flow_world import MIB, Link, arrived
from hypothesis import given
from hypothesis import strategies as st

from services.mesh.core.link import flow
from services.mesh.core.link.flow import Fragment, Receipts, SendWindow, decode_ack, encode_ack, encode_fragment
from services.mesh.core.link.outbox import (
    FOR_LATEST,
    LIMITS,
    MAX_BEGUN,
    WIRE_CLASS,
    Outbox,
    OutgoingPart,
    QueuedMessage,
)
from services.mesh.core.wire import frames
from services.mesh.core.wire.frames import BULK, CONTROL, HALTS, SYNC
from swarm.errors import FrameError

BANDWIDTH = 78_000.0


def transfer(link: Link, size: int = MIB, within: float = 60.0) -> float:
    """Send so much as one message; the time it took."""
    payload = bytes(range(256)) * (size // 256)
    start = link.now
    assert link.send(link.a, BULK, "big", payload)
    link.run(within, lambda: bool(arrived(link.b, "big")))
    ((time, data),) = arrived(link.b, "big")
    assert data == payload
    return time - start


class Pings:
    """Small sync messages both ways, as lockstep sends them."""

    def __init__(self, link: Link, period: float) -> None:
        self.link, self.period, self.sent = link, period, 0
        self.times: dict[int, float] = {}
        self._send()

    def _send(self) -> None:
        for side in (self.link.a, self.link.b):
            self.link.send(side, SYNC, "ping", self.sent.to_bytes(4, "little") + bytes(21))
        self.times[self.sent] = self.link.now
        self.sent += 1
        self.link.at(self.link.now + self.period, self._send)

    def delays(self) -> list[float]:
        pings = arrived(self.link.b, "ping")
        return [time - self.times[int.from_bytes(data[:4], "little")] for time, data in pings]


def test_a_mebibyte_uses_the_link() -> None:
    link = Link()
    time = transfer(link)
    assert MIB / time >= 0.9 * BANDWIDTH
    assert link.a.counters["sent_bulk"] == 1
    assert link.b.written < 0.05 * MIB, "acknowledgements are few"


def test_a_small_message_overtakes_it_and_both_get_what_they_need() -> None:
    link = Link()
    pings = Pings(link, 0.035)
    link.run(5.0)
    quiet = statistics.median(pings.delays())
    link.b.inbox.clear()
    time = transfer(link)
    assert MIB / time >= 0.85 * BANDWIDTH
    assert statistics.median(pings.delays()) <= 1.6 * quiet


def test_no_small_message_waits_longer_than_the_window_and_a_write() -> None:
    link = Link()
    limits: list[float] = []
    pings = Pings(link, 0.1)
    start = link.now

    def note() -> None:
        limits.append(link.a.session.window.limit)
        link.at(link.now + 0.01, note)

    note()
    transfer(link)
    assert link.now - start > 10.0
    largest_write = flow.MIN_WINDOW + flow.FRAGMENT + 20
    assert max(pings.delays()) <= 0.03 + (max(limits) + largest_write) / BANDWIDTH
    assert max(limits) < 10_000


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_jitter_costs_a_large_message_little_bandwidth(seed: int) -> None:
    link = Link(jitter=0.01, seed=seed)
    assert MIB / transfer(link) >= 0.75 * BANDWIDTH


def test_a_fast_link_gets_a_large_window() -> None:
    link = Link(latency=0.002, bandwidth=2e6)
    assert 2 * MIB / (transfer(link) + transfer_again(link)) >= 0.5 * 2e6


def transfer_again(link: Link) -> float:
    link.b.inbox.clear()
    return transfer(link)


def test_on_a_slow_link_little_waits_in_the_socket() -> None:
    link = Link(bandwidth=5_000.0)
    time = transfer(link, 200_000)
    assert 200_000 / time >= 0.8 * 5_000.0
    assert link.a.session.window.limit <= 4000


def test_a_link_that_becomes_slower_gets_a_smaller_window() -> None:
    link = Link()
    link.send(link.a, BULK, "big", bytes(MIB))
    link.run(4.0)
    assert link.a.session.window.limit > 4000
    link.b.line._model = type(link.b.line._model)(0.03, 0.0, 8_000.0)
    link.run(20.0)
    assert link.a.session.window.limit < 2500


def test_small_messages_on_a_quiet_link_leave_its_window_alone() -> None:
    """They are acknowledged with what follows them: that time says nothing of the link."""
    link, chance = Link(), random.Random(1)

    def send() -> None:
        for side in (link.a, link.b):
            link.send(side, chance.choice((BULK, CONTROL)), "small", bytes(chance.randrange(50, 400)))
        link.at(link.now + chance.uniform(0.05, 0.5), send)

    send()
    link.run(120.0)
    assert [side.session.window.limit for side in (link.a, link.b)] == [flow.FIRST_WINDOW] * 2


def test_the_smallest_window_grows_again() -> None:
    """An eighth more than one write has no room for a second one: a larger window must have it."""
    link = Link()
    link.run(1.0)
    link.a.session.window.limit = float(flow.MIN_WINDOW)
    assert MIB / transfer(link) >= 0.75 * BANDWIDTH


def test_lockstep_alone_costs_almost_no_acknowledgements() -> None:
    link = Link()
    link.run(1.0)
    before, frames_before = link.b.written, link.b.session.sent
    Pings(link, 0.031)
    link.run(10.0)
    heartbeats = 20 * 3  # with CLOCK and ACK
    acknowledgements = link.b.session.sent - frames_before - heartbeats - 10.0 / 0.031
    assert acknowledgements < 10.0 / 0.031 / 8
    assert link.b.written - before < 15_000


def test_one_way_traffic_is_acknowledged_too() -> None:
    link = Link()

    def send() -> None:
        link.send(link.a, SYNC, "s", bytes(400))
        link.at(link.now + 0.01, send)

    send()
    link.run(5.0)
    assert link.a.session.window.in_flight < 5000


def test_a_class_of_sync_that_fills_the_link_leaves_bulk_its_share() -> None:
    link = Link()

    def flood() -> None:
        for _ in range(20):
            link.send(link.a, SYNC, "flood", bytes(500))
        link.at(link.now + 0.05, flood)

    flood()
    link.send(link.a, BULK, "big", bytes(300_000))
    link.run(60.0, lambda: bool(arrived(link.b, "big")))
    assert arrived(link.b, "big"), "not starved"
    sync = sum(len(data) for _, data in arrived(link.b, "flood"))
    assert sync > 4 * 300_000, "but sync had far more"
    assert link.a.session.window.in_flight < 20_000, "and the kernel's queue stayed short"


def test_an_acknowledgement_of_more_than_was_sent_ends_the_connection() -> None:
    link = Link()
    link.a.session.receive(encode_ack(link.a.session.window.sent + 1), link.now)
    assert link.a.session.state == "down"
    assert link.a.counters["bad_frames"] == 1


@given(st.lists(st.tuples(st.integers(0, 5000), st.integers(0, 5000)), max_size=80))
def test_bytes_under_way_are_counted_across_the_wrap(steps: list[tuple[int, int]]) -> None:
    window = SendWindow()
    window.sent = window.acknowledged = (1 << 32) - 7000
    now, acknowledged = 0.0, window.sent
    for size, taken in steps:
        now += 0.01
        window.wrote(size, now, bulk=True, waits=True)
        acknowledged = min(window.sent, acknowledged + taken)
        window.on_ack(decode_ack(encode_ack(acknowledged)[3:]), now)
        assert window.in_flight == window.sent - acknowledged
        assert flow.MIN_WINDOW <= window.limit <= flow.MAX_WINDOW
    with pytest.raises(FrameError, match="under way"):
        window.on_ack((window.sent + 1) % (1 << 32), now)


def test_receipts_are_due_by_bytes() -> None:
    receipts = Receipts()
    receipts.taken = 511
    receipts.bulk = True
    assert not receipts.due()
    assert receipts.take(at_once=False) is None
    receipts.taken = 512
    assert receipts.due()
    assert receipts.take(at_once=False) == 512
    receipts.taken = 600
    assert not receipts.due()
    assert receipts.take(at_once=True) == 600
    assert receipts.take(at_once=True) is None
    receipts.taken = 600 + 1024
    assert receipts.due(), "even without bulk"


def test_what_a_robot_passes_on_by_the_piece_leaves_write_by_write() -> None:
    """Without a pace a piece of six fragments stands in the socket at once, and takes 25 ms to leave it."""
    link, size = Link(), 1924
    standing: list[int] = []

    def pass_on() -> None:
        link.send(link.a, BULK, "piece", bytes(size))
        link.at(link.now + size / (0.95 * BANDWIDTH), pass_on)

    def note() -> None:
        standing.append(sum(map(len, link.a.socket)))
        link.at(link.now + 0.0017, note)

    pass_on()
    link.run(5.0)
    note()
    link.run(20.0)
    write = flow.FRAGMENT + 40
    assert statistics.quantiles(standing, n=100)[-1] <= write
    assert max(standing) <= 2 * write
    assert len(arrived(link.b, "piece")) >= 0.99 * 25.0 * 0.95 * BANDWIDTH / size


def test_only_bulk_waits_for_the_pace() -> None:
    window = SendWindow()
    window.wrote(600, 0.0, bulk=True, waits=True)
    assert window.free(0, 0.0) > 0, "no round trip is known yet"
    window.on_ack(600, 0.06)
    window.wrote(600, 0.1, bulk=True, waits=True)
    assert window.next_bulk == pytest.approx(0.1 - flow.LATE + 600 * 0.06 / (flow.PACE * window.limit))
    assert window.free(0, 0.1) == 0.0
    assert window.free(0, window.next_bulk) > 0.0
    outbox = Outbox(Counter())
    outbox.push(SYNC, "s", b"", latest=False)
    assert outbox.leaves(window.free(0, 0.1))
    assert outbox.pop(window.free(0, 0.1)) is not None


def test_a_link_that_was_silent_for_seconds_is_hardly_slower_afterwards() -> None:
    link = Link()
    link.send(link.a, BULK, "big", bytes(MIB))
    link.run(3.0)
    link.b.line.free_at = link.now + 2.5  # the other robot's radio is elsewhere
    link.run(2.6)
    taken = link.a.session.window.acknowledged
    link.run(1.0)
    assert link.a.session.window.acknowledged - taken >= 0.5 * BANDWIDTH


@pytest.mark.parametrize("size", [100, 300, 1000])
def test_bulk_does_not_stand_still_after_a_flood_of_sync(size: int) -> None:
    """In the flood bulk leaves as sync's share for it, before its time; those writes must not add up to minutes."""
    link = Link()
    ends = link.now + 30.0

    def flood() -> None:
        link.send(link.a, SYNC, "flood", bytes(size))
        if link.now < ends:
            link.at(link.now + (size + 20) / (1.2 * BANDWIDTH), flood)

    flood()
    link.send(link.a, BULK, "big", bytes(MIB))
    link.run(30.0)
    assert link.a.session.window.next_bulk <= link.now + 1.0
    link.run(2.0)
    taken = link.a.session.window.acknowledged
    link.run(1.0)
    assert link.a.session.window.acknowledged - taken >= 5000


def test_a_link_whose_first_round_trip_is_long_is_hardly_slower_afterwards() -> None:
    link = Link()
    link.b.line.free_at = link.now + 2.0
    link.send(link.a, BULK, "big", bytes(MIB))
    link.run(3.2)
    taken = link.a.session.window.acknowledged
    link.run(1.0)
    assert link.a.session.window.acknowledged - taken >= 0.8 * BANDWIDTH


def test_a_trial_ends_where_the_window_is_full_no_more() -> None:
    link = Link()
    link.send(link.a, BULK, "big", bytes(MIB))
    assert link.run(10.0, lambda: link.a.session.window.limit > flow.FIRST_WINDOW)
    link.a.session.queue.clear()
    link.run(2.0)
    link.send(link.a, BULK, "small", b"x")
    assert link.a.session.window.limit == pytest.approx(flow.FIRST_WINDOW)


def test_bulk_pushes_back_and_keeps_room_for_latest_values() -> None:
    counters: Counter[str] = Counter()
    outbox = Outbox(counters)
    taken = 0
    while outbox.push(BULK, f"key{taken % 7}", bytes(50_000), latest=False):
        taken += 1
    assert taken == (LIMITS[BULK].size - FOR_LATEST.size) // 50_004
    assert counters == {"pushed_back": 1}
    assert outbox.push(BULK, "state", bytes(100), latest=True)
    assert outbox.push(BULK, "state", bytes(200), latest=True)
    assert not outbox.push(BULK, "huge", bytes(300_000), latest=True)
    assert outbox.dropped == 2
    assert outbox.push(SYNC, "s", b"", latest=False)
    assert outbox.waiting == taken + 2


def test_the_largest_message_fits() -> None:
    assert Outbox(Counter()).push(BULK, "k" * 255, bytes(MIB), latest=False)


def test_a_small_message_of_another_key_does_not_wait_for_a_large_one() -> None:
    outbox = Outbox(Counter())
    outbox.push(BULK, "large", bytes(MIB), latest=False)
    assert isinstance(outbox.pop(fragment=976), OutgoingPart)
    outbox.push(BULK, "small", b"x", latest=False)
    keys = [
        item.message.key if isinstance(item, OutgoingPart) else item.key for item in (outbox.pop(fragment=976),) if item
    ]
    keys += [
        item.message.key if isinstance(item, OutgoingPart) else item.key for item in (outbox.pop(fragment=976),) if item
    ]
    assert sorted(keys) == ["large", "small"]


def test_a_latest_value_that_has_begun_is_finished_and_the_newest_follows() -> None:
    outbox = Outbox(Counter())
    outbox.push(BULK, "map", b"1" * 600, latest=True)
    first = cast("OutgoingPart", outbox.pop(fragment=256))
    outbox.push(BULK, "map", b"2" * 600, latest=True)
    outbox.push(BULK, "map", b"3" * 600, latest=True)
    data = first.data
    while isinstance(item := outbox.pop(fragment=256), OutgoingPart):
        data += item.data
    assert data == b"1" * 600 + b"3" * 600


def test_only_so_many_large_messages_are_begun() -> None:
    outbox, begun = Outbox(Counter()), set()
    for number in range(60):
        outbox.push(BULK, f"large{number}", bytes(5000), latest=False)
        outbox.push(BULK, f"small{number}", b"x", latest=False)
    for _ in range(100):
        item = outbox.pop(fragment=256)
        if isinstance(item, OutgoingPart):
            begun.add(item.message.key)
    assert len(begun) == MAX_BEGUN
    while outbox.pop(fragment=256) is not None:
        assert outbox._begun <= MAX_BEGUN
    assert not outbox


def test_a_stop_is_never_held_back() -> None:
    outbox = Outbox(Counter())
    outbox.push(BULK, "b", b"", latest=False)
    outbox.push(SYNC, "s", b"", latest=False)
    outbox.push(CONTROL, "c", b"", latest=False)
    outbox.push(HALTS, "h", b"", latest=False)
    full = -flow.SYNC_EXTRA
    assert outbox.leaves(full)
    stop = outbox.pop(full)
    assert isinstance(stop, QueuedMessage)
    assert (stop.key, WIRE_CLASS[stop.priority]) == ("h", CONTROL)
    assert outbox.pop(full) is None
    assert not outbox.leaves(full)
    for key in "cs":
        found = outbox.pop(full + 1)
        assert isinstance(found, QueuedMessage)
        assert found.key == key
    assert outbox.pop(0) is None
    assert outbox.leaves(1)


def test_a_flood_of_control_costs_no_stop_its_place() -> None:
    """As of an app that sends in the class control."""
    outbox = Outbox(counters := Counter())
    outbox.push(HALTS, "h", b"", latest=False)
    for _ in range(2 * LIMITS[CONTROL].messages):
        outbox.push(CONTROL, "c", bytes(1000), latest=False)
    assert counters["overflowed"] > 0
    stop = outbox.pop()
    assert isinstance(stop, QueuedMessage)
    assert stop.key == "h"
    outbox.push(HALTS, "h", b"", latest=False)
    outbox.clear()
    assert outbox.pop() is None
    assert outbox.waiting_bytes == 0


def test_a_frame_of_a_fragment_fits_a_bluetooth_packet_of_three_slots() -> None:
    first = encode_fragment(Fragment(1, 0, False, MIB, bytes(flow.FRAGMENT)))
    assert len(first) + frames.TAG_SIZE <= 552 - 4 - 6, "3-DH3, without the headers of L2CAP and RFCOMM"
