"""What a robot asks for when pieces of a large message are late or lost."""

from collections import Counter
from collections.abc import Sequence
from random import Random

import pytest
from hypothesis import given
from hypothesis import strategies as st
from large_world import large
from mesh_world import World

from services.mesh.core.bulk import pieces
from services.mesh.core.bulk.exchange import COUNTERS, MOST_PROBES, TIMEOUT, BulkExchange
from services.mesh.core.bulk.pieces import ASKED, GONE, PIECE, REORDERED, SIZE, WANT, MessageId, Packet
from swarm.messages import SendRequest

ID = MessageId("r1", 1, 1, flood=False)


class Fetching:
    """r0 fetches a message from r1, whose answers the test decides about."""

    def __init__(self, count: int) -> None:
        self.counters = dict.fromkeys(COUNTERS, 0)
        self.finished: list[bytes | None] = []
        self._wants: list[int] = []
        self.exchange = BulkExchange(
            "r0",
            emit=self._emit,
            has=lambda id, peer: None,
            finished=lambda id, payload, now: self.finished.append(payload),
            others=lambda: (),
            counters=self.counters,
        )
        self.exchange.fetch(ID, count * SIZE, "r1", 0.0)

    def _emit(self, packet: Packet) -> bool:
        self._wants += pieces.decode_want(packet.body).indexes
        return True

    def wants(self) -> list[int]:
        """The pieces that were asked for since the last call."""
        wants, self._wants = self._wants, []
        return wants

    def come(self, indexes: Sequence[int], now: float) -> None:
        for index in indexes:
            body = pieces.encode_piece(index, bytes([index % 256]) * SIZE)
            self.exchange.receive(Packet(PIECE, "r1", "r0", ID, body), now)


def test_pieces_that_were_late_are_asked_for_once() -> None:
    fetching = Fetching(40)
    assert fetching.wants() == list(range(ASKED))
    fetching.exchange.handle_timer(TIMEOUT)
    assert fetching.wants() == [ASKED]
    fetching.come(range(ASKED + 1), 3.0)
    assert fetching.wants() == list(range(ASKED + 1, 40))
    fetching.come(range(ASKED + 1, 40), 4.0)
    assert [len(payload or b"") for payload in fetching.finished] == [40 * SIZE]
    assert fetching.counters["pieces_repeated"] == 0


def test_pieces_that_were_lost_are_asked_for_when_a_later_one_comes() -> None:
    fetching = Fetching(100)
    fetching.wants()
    fetching.come([REORDERED], 0.1)
    assert fetching.counters["pieces_repeated"] == 0
    fetching.come([REORDERED + 1], 0.2)
    assert fetching.counters["pieces_repeated"] == 1
    assert 0 in fetching.wants()


def test_pieces_that_were_lost_are_asked_for_when_the_one_after_a_silence_comes() -> None:
    fetching = Fetching(40)
    fetching.wants()
    fetching.exchange.handle_timer(TIMEOUT)
    fetching.come(fetching.wants(), 2.1)
    assert fetching.wants() == list(range(ASKED))
    assert fetching.counters["pieces_repeated"] == ASKED


def test_after_a_change_of_ways_one_more_piece_tells_what_was_lost_with_the_old_way() -> None:
    fetching = Fetching(40)
    fetching.wants()
    fetching.exchange.ways_changed(0.2)
    assert fetching.wants() == [ASKED]
    fetching.come([ASKED], 0.3)
    assert fetching.wants() == list(range(ASKED))


def test_without_a_further_piece_a_change_of_ways_repeats_them_after_a_silence_only() -> None:
    fetching = Fetching(3)
    fetching.wants()
    fetching.exchange.ways_changed(0.2)
    assert fetching.wants() == []
    fetching.exchange.handle_timer(TIMEOUT)
    fetching.wants()
    fetching.exchange.ways_changed(TIMEOUT + 0.2)
    assert fetching.wants() == [0, 1, 2]


def test_without_a_further_piece_the_last_one_is_asked_for_again() -> None:
    late, lost = Fetching(3), Fetching(3)
    for fetching in (late, lost):
        assert fetching.wants() == [0, 1, 2]
        fetching.exchange.handle_timer(TIMEOUT)
        assert fetching.wants() == [2]
    late.come([0, 1, 2], 2.1)
    lost.come([2], 2.1)
    assert (late.wants(), lost.wants()) == ([], [0, 1])
    lost.come([0, 1], 2.2)
    assert late.finished == lost.finished != [None]


def test_all_pieces_are_asked_for_again_where_the_last_one_stays_away() -> None:
    fetching = Fetching(3)
    fetching.wants()
    fetching.exchange.handle_timer(TIMEOUT)
    assert fetching.wants() == [2]
    fetching.exchange.handle_timer(3 * TIMEOUT)
    assert fetching.wants() == [0]
    fetching.come([0], 3 * TIMEOUT + 0.1)
    assert fetching.wants() == [1, 2]


@pytest.mark.parametrize("lost", [0.0, 0.3])
@given(st.integers(0, 10_000), st.integers(1, 100), st.floats(0.01, 3.0))
def test_a_message_arrives_whatever_is_lost_or_late(lost: float, seed: int, count: int, late: float) -> None:
    """Each piece comes up to `late` seconds after it was asked for, in order, if it was not lost, which happens to a
    piece twice at most. Without losses none is asked for twice but the last one, after silence."""
    fetching, now, under_way = Fetching(count), 0.0, list[tuple[float, int]]()
    random, asked = Random(seed), Counter[int]()
    while not fetching.finished and now < 300.0:
        for index in fetching.wants():
            asked[index] += 1
            if random.random() >= lost or asked[index] > 2:
                under_way.append((max([now + random.uniform(0.0, late), *(at for at, _ in under_way)]), index))
        next_at = min((at for at, _ in under_way), default=now + 60.0)
        now = min(next_at, max(now, fetching.exchange.next_deadline()))
        fetching.exchange.handle_timer(now)
        while under_way and under_way[0][0] <= now:
            fetching.come([under_way.pop(0)[1]], now)
    assert fetching.finished == [b"".join(bytes([index % 256]) * SIZE for index in range(count))]
    if not lost:
        assert all(asked[index] == 1 for index in range(count - 1))


def test_many_robots_send_to_one_at_the_rate_of_its_link_and_nothing_is_asked_for_twice() -> None:
    """Their pieces wait for 9 s in the queue of the last link."""
    senders = [f"s{number}" for number in range(12)]
    world = World([("hub", "r0"), *((name, "hub") for name in senders)], bandwidth=78_000.0)
    world.run(5.0)
    began = world.now
    for name in senders:
        request = SendRequest("t", "x", "r0", large(1, 120_000), "bulk", 100.0)
        world.step(name, lambda node, request=request: node.ask(lambda o, now: o.request(request, now), world.now))
    got = lambda: sum("/send/" in key for key, _ in world.bots["r0"].inbox) == len(senders)  # noqa: E731
    assert world.run(60.0, until=got)
    assert 12 * 120_000 / (world.now - began) > 0.9 * 78_000.0
    counters = sum((Counter(bot.node._counters) for bot in world.bots.values()), Counter[str]())
    assert counters["pieces_repeated"] == 0


# -- several messages of one robot -----------------------------------------------------------------------------


class Link:
    """r0 fetches messages from others, whose pieces come in the order in which they were asked for."""

    def __init__(self, rate: float = 60_000.0) -> None:
        self.rate = rate
        self.now = 0.0
        self.down: set[str] = set()
        self.silent: set[MessageId] = set()
        """Messages of which no piece comes."""
        self.asked: list[tuple[str, MessageId, int]] = []
        self.first_asked: dict[MessageId, float] = {}
        self.ended: dict[MessageId, bytes | None] = {}
        self.totals: dict[MessageId, int] = {}
        self.exchange = BulkExchange(
            "r0",
            emit=self._emit,
            has=lambda id, peer: None,
            finished=lambda id, payload, now: self.ended.update({id: payload}),
            others=lambda: (),
            counters=dict.fromkeys(COUNTERS, 0),
        )

    def _emit(self, packet: Packet) -> bool:
        if packet.to in self.down:
            return False
        if packet.kind == WANT:
            for index in pieces.decode_want(packet.body).indexes:
                self.asked.append((packet.to, packet.id, index))
                self.first_asked.setdefault(packet.id, self.now)
        return True

    def fetch(self, id: MessageId, total: int, source: str) -> None:
        self.totals[id] = total
        self.exchange.fetch(id, total, source, self.now)

    def under_way(self) -> int:
        return sum(each.asked for each in self.exchange.fetching)

    def run(self, until: float) -> None:
        while self.now < until:
            self.asked = [each for each in self.asked if each[1] not in self.silent]
            arrival = self.now + SIZE / self.rate if self.asked else float("inf")
            self.now = min(until, arrival, max(self.now, self.exchange.next_deadline()))
            self.exchange.handle_timer(self.now)
            if self.now >= arrival and self.asked:
                source, id, index = self.asked.pop(0)
                body = pieces.encode_piece(index, bytes(min(SIZE, self.totals[id] - index * SIZE)))
                self.exchange.receive(Packet(PIECE, source, "r0", id, body), self.now)


def unicast(number: int) -> MessageId:
    return MessageId("r1", 1, number, flood=False)


def test_the_messages_of_one_robot_take_turns() -> None:
    """A small one behind two long ones neither waits for their end nor looks as if nobody asked for it."""
    link = Link()
    for number, total in ((1, 900_000), (2, 900_000), (3, 100_000)):
        link.fetch(unicast(number), total, "r1")
    link.run(10.0)
    assert link.ended.keys() == {unicast(3)}
    assert link.first_asked[unicast(3)] < 1.0
    link.run(60.0)
    assert all(len(link.ended[id] or b"") == total for id, total in link.totals.items())


@pytest.mark.parametrize("kind", ["gone", "dropped", "complete"])
def test_the_places_of_a_message_that_ends_go_to_the_next_one(kind: str) -> None:
    link = Link()
    link.fetch(unicast(1), 60_000, "r1")
    link.fetch(unicast(2), 60_000, "r1")
    assert unicast(2) not in link.first_asked
    if kind == "gone":
        link.exchange.receive(Packet(GONE, "r1", "r0", unicast(1), b""), link.now)
    elif kind == "dropped":
        link.exchange.drop(unicast(1), link.now)
    else:
        link.run(1.5)
    assert unicast(2) in link.first_asked
    link.run(5.0)
    assert len(link.ended[unicast(2)] or b"") == 60_000


def test_a_message_that_stalls_leaves_the_others_their_places_and_goes_on_when_it_comes() -> None:
    """As a flood of which its sender waits for pieces itself."""
    link = Link()
    stalled, others = MessageId("r9", 1, 1, flood=True), [unicast(1), MessageId("r1", 1, 2, flood=True)]
    link.silent = {stalled}
    link.fetch(stalled, 500_000, "r1")
    link.run(1.0)
    for id in others:
        link.fetch(id, 100_000, "r1")
    link.run(12.0)
    assert all(len(link.ended[id] or b"") == 100_000 for id in others)
    link.silent = set()
    link.run(40.0)
    assert len(link.ended[stalled] or b"") == 500_000


def test_a_message_that_stalls_at_one_robot_is_fetched_from_another_while_others_come() -> None:
    link = Link()
    flood, other = MessageId("r9", 1, 1, flood=True), unicast(1)
    link.fetch(flood, 100_000, "r1")
    link.exchange.add_source(flood, "r2", link.now)
    link.asked.clear()  # r1 does not answer
    link.fetch(other, 900_000, "r1")
    link.run(10.0)
    assert len(link.ended[flood] or b"") == 100_000


def test_changes_of_ways_ask_for_few_pieces_more() -> None:
    link = Link()
    link.fetch(unicast(1), 900_000, "r1")
    for _ in range(300):
        link.exchange.ways_changed(link.now)
    assert link.under_way() <= ASKED + MOST_PROBES


@given(
    st.lists(
        st.tuples(
            st.sampled_from(["fetch", "add", "ways", "down", "up", "gone", "wait"]),
            st.integers(1, 5), st.sampled_from(["r1", "r2", "r3"]), st.floats(0.0, 5.0),
        ),
        max_size=40,
    )
)  # fmt: skip
def test_whatever_becomes_of_ways_and_sources_every_message_ends(events: list[tuple[str, int, str, float]]) -> None:
    link = Link()
    for what, number, robot, seconds in events:
        id = MessageId("r9", 1, number, flood=True)
        if what == "fetch" and id not in link.totals:
            link.fetch(id, 100_000, robot)
        elif what == "add":
            link.exchange.add_source(id, robot, link.now)
        elif what == "ways":
            link.exchange.ways_changed(link.now)
        elif what in ("down", "up"):
            (link.down.add if what == "down" else link.down.discard)(robot)
            link.asked = [each for each in link.asked if each[0] not in link.down]
            link.exchange.ways_changed(link.now)
        elif what == "gone":
            link.exchange.receive(Packet(GONE, robot, "r0", id, b""), link.now)
        else:
            link.run(link.now + seconds)
        assert link.under_way() <= 3 * (ASKED + MOST_PROBES) + 5
    link.run(link.now + 200.0)
    assert link.ended.keys() == link.totals.keys()
    assert not link.exchange.fetching
