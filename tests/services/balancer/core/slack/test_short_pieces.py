"""Slack tasks that are cut into pieces of whatever size the rest of a tick has room for do the same as in one piece."""

import random

from hypothesis import given
from hypothesis import strategies as st

from services.balancer.core.control.body import body_model
from services.balancer.core.devices.mailbox import Mailbox
from services.balancer.core.devices.tune import Player, loudness, pitch
from services.balancer.core.devices.uwb import UwbReader
from services.balancer.core.slack.wire_time import Room
from services.dwm.core.module.tlv import LOC_GET, AnchorRange, Location, Position, encode_location
from sim.core.balboa import BalboaBody
from sim.core.devices import NO_ERRORS, SimulatedRobot
from swarm.config.types import Body
from swarm.messages import ModuleRequest, Note, SetNotes, Uwb

TICK = 0.01

rooms = st.lists(st.integers(-3, 32), min_size=1, max_size=12).filter(lambda sizes: max(sizes) >= 4)
"""What there is room for in ticks, over and over; below 1 a tick has none. Nothing that cannot be cut has more than 4
bytes."""


class Pieces:
    """A simulated ATmega and one task, in ticks that have room for so many bytes."""

    def __init__(self, sizes: list[int]) -> None:
        self.now = 100.0
        body = BalboaBody(body_model("zero2w", Body()), self.now)
        self.robot = SimulatedRobot(body, random.Random(1), errors=NO_ERRORS)
        self.sizes = sizes
        self.ticks = 0
        self.answers: dict[bytes, bytes] = {}
        self.asked: list[bytes] = []

    def tick(self, task: object) -> None:
        self.now += TICK
        size = self.sizes[self.ticks % len(self.sizes)]
        self.ticks += 1
        atmega = self.robot.atmega
        atmega.advance(self.now)
        if (asked := atmega.line.to_send()) != b"":
            self.asked.append(asked)
            atmega.line.receive(self.answers.get(asked, b""), self.now)
        if isinstance(task, UwbReader):
            task.notice(atmega.line.newest % 16)
        transfer = task.next(self.now, Room(size, size, size))
        if transfer is None or max(len(transfer.data) - 1, transfer.reads) > size:
            return
        atmega.write(transfer.data, self.now)
        task.take(atmega.read(transfer.reads, self.now) if transfer.reads else b"", self.now)


def location(first: int, count: int, away: float, places: float) -> Location:
    anchors = (AnchorRange(f"{first + n:04X}", n + away, 90, Position(n + places, 0.0, 0.0, 100)) for n in range(count))
    return Location(Position(away, 2.0, 0.1, 90), tuple(anchors))


def test_a_reader_of_reports_is_not_behind_when_no_more_come_or_the_atmega_was_reset() -> None:
    """What it has missed long ago says nothing of the bus now."""
    pieces = Pieces([4, *[-1] * 4])
    pieces.answers[LOC_GET.request] = encode_location(location(0x1000, 4, 0.1, 1.0))
    reader = UwbReader(pieces.now)

    def run(seconds: float) -> bool:
        for _ in range(round(seconds / TICK)):
            pieces.tick(reader)
        return reader.behind

    assert run(30.0)
    pieces.answers.clear()
    assert not run(10.0), "the module is silent"
    pieces.answers[LOC_GET.request] = encode_location(location(0x1000, 4, 0.1, 1.0))
    assert run(30.0)
    reader.restart()
    assert not reader.behind
    assert run(30.0)
    pieces.sizes = [32]
    assert not run(10.0), "it has caught up"


@given(rooms, st.integers(0, 6), st.randoms(use_true_random=False))
def test_reports_are_whole_and_each_anchor_has_its_own_place(
    sizes: list[int], count: int, chance: random.Random
) -> None:
    """Every report has other distances; anchors come and go, and each stands where its address says."""
    pieces, told = Pieces(sizes), []
    reader = UwbReader(pieces.now)
    for tick in range(600):
        if tick % 7 == 0:
            first = 0x1000 * chance.randint(1, 3)
            said = location(first, count, round(tick / 1000, 3), float(first))
            pieces.answers[LOC_GET.request] = encode_location(said)
        pieces.tick(reader)
        if isinstance(reader.news, Uwb) and reader.news.state == "ok" and reader.news.sequence:
            told.append(reader.news)
        reader.news = None
    assert told
    for each in told:
        assert each.count == count
        for n, found in enumerate(each.ranges):
            first = int(found.anchor, 16) - n
            assert round(found.distance - n, 3) == each.x, "of one report"
            assert found.x == first + n, "its own place"


def test_an_anchor_that_was_moved_is_known_there_within_five_seconds() -> None:
    pieces = Pieces([8])
    reader = UwbReader(pieces.now)
    places = []
    for places_at in (0.0, 5.0):
        pieces.answers[LOC_GET.request] = encode_location(location(0x1000, 4, 0.1, places_at))
        for _ in range(500):
            pieces.tick(reader)
        assert reader.news is not None
        places.append([each.x for each in reader.news.ranges])
    assert places == [[0.0, 1.0, 2.0, 3.0], [5.0, 6.0, 7.0, 8.0]]


@given(rooms, st.binary(min_size=0, max_size=253), st.integers(0, 250))
def test_a_request_and_its_answer_pass_in_pieces(sizes: list[int], value: bytes, length: int) -> None:
    pieces, mailbox = Pieces(sizes), Mailbox()
    request = bytes((0x99, len(value))) + value
    answer = bytes.fromhex("400100") + bytes((0x77, length)) + bytes(range(length))
    pieces.answers[request] = answer
    mailbox.post(ModuleRequest("t", request), pieces.now)
    mailbox._give_up_at = pieces.now + 1e6  # time is not what this is about
    while mailbox.news is None:
        pieces.tick(mailbox)
    assert (mailbox.news.answer, mailbox.news.problem) == (answer, "")
    assert request in pieces.asked


@given(rooms, st.lists(st.tuples(st.integers(12, 119), st.integers(1, 30), st.sampled_from((1.0, 0.5))), max_size=64))
def test_all_notes_are_played_in_pieces(sizes: list[int], melody: list[tuple[int, int, float]]) -> None:
    notes = tuple(Note(440.0 * 2 ** ((midi - 69) / 12), duration / 100, volume) for midi, duration, volume in melody)
    pieces, player = Pieces(sizes), Player()
    player.play(SetNotes(notes), pieces.now)
    played: list[tuple[int, int, int]] = []
    before = pieces.robot.atmega.tune
    for _ in range(sum(duration for _, duration, _ in melody) + 13 * len(melody) + 20):
        pieces.tick(player)
        if (tune := pieces.robot.atmega.tune) is not before:
            before = tune
            played += [(tune[0], *each) for each in tune[1]]
    assert played == [(loudness(each.volume), pitch(each.frequency), round(each.duration * 100)) for each in notes]
