"""The balancer's drivers and slack tasks against the simulated ATmega and the real firmware: the same tests twice."""

import itertools

import pytest
from both_robots import Real, Simulated
from conftest import examples
from firmware_layout import FIELDS
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from services.balancer.core.devices import balboa
from services.balancer.core.devices.health import BoardHealth
from services.balancer.core.devices.mailbox import Mailbox
from services.balancer.core.devices.tune import Player
from services.balancer.core.devices.uwb import UwbReader
from services.balancer.core.slack.wire_time import LONGEST
from services.balancer.device_drivers import Balboa
from services.dwm.core.module.tlv import LOC_GET, AnchorRange, Location, Position, encode_location
from swarm.messages import ModuleRequest, Note, SetNotes

pytest_plugins = ("firmware_fixtures",)

TICK = 0.01
CFG_GET = ModuleRequest("cfg", b"\x08\x00")
CFG = bytes.fromhex("400100 46025010")


class Driven:
    """A robot, its driver, and one task after the other in ticks of 10 ms."""

    def __init__(self, robot) -> None:
        self.robot = robot
        self.balboa = Balboa(robot.bus, robot.clock, robot.run)
        self.now = robot.clock
        self.transfers: list = []
        self.answers: dict[bytes, bytes] = {}
        """What the module says to a request, 12 ms later."""
        self.asked: list[bytes] = []
        self._said = b""
        self._due: list[tuple[float, bytes]] = []

    def tick(self, *tasks) -> None:
        self.balboa.select(balboa.ENCODERS)
        newest = self.balboa.fetch_motion()[0].newest_report
        for task in tasks:
            if isinstance(task, UwbReader):
                task.notice(newest)
            if (transfer := task.next(self.now())) is not None:
                self.transfers.append(transfer)
                at = self.now()
                try:
                    data = self.balboa.transfer(transfer)
                except OSError as error:
                    task.fail(error, at)
                else:
                    task.take(data, at)
        for _ in range(5):
            self.robot.run(TICK / 5)
            self._module()

    def _module(self) -> None:
        if sent := self.robot.sent():
            self._said += sent
        elif self._said:  # a pause: the request is whole
            self.asked.append(self._said)
            if reply := self.answers.get(self._said):
                self._due.append((self.now() + 0.012, reply))
            self._said = b""
        while self._due and self.now() >= self._due[0][0]:
            self.robot.feed(self._due.pop(0)[1])

    def until_news(self, task, limit: float = 4.0):
        end = self.now() + limit
        while task.news is None:
            assert self.now() < end, f"no news within {limit} s"
            self.tick(task)
        news, task.news = task.news, None
        return news


@pytest.fixture(params=["simulated", "firmware"])
def driven(request: pytest.FixtureRequest) -> Driven:
    if request.param == "simulated":
        return Driven(Simulated())
    return Driven(Real(request.getfixturevalue("bench")))


def location(first: int = 0xC930, count: int = 4) -> Location:
    anchors = (
        AnchorRange(f"{first + n:04X}", 1.5 + n, 80 + n, Position(float(n), 2.0 * n, -0.5, 100)) for n in range(count)
    )
    return Location(Position(1.234, -2.5, 0.75, 87), tuple(anchors))


def test_the_atmega_is_found_and_shows_its_state(driven: Driven) -> None:
    driven.robot.press(0b101)
    driven.robot.run(0.05)
    found = driven.balboa.set_up()
    assert found.battery == pytest.approx(7.4, abs=0.05)
    assert found.buttons == (True, False, True)
    assert (found.revision, found.encoder_errors, found.bus_resets) == (2, (0, 0), 0)
    driven.balboa.select(balboa.ENCODERS)
    assert driven.balboa.fetch_motion() == (balboa.MotionBlock(0, 0, 0b101, False), b"")
    driven.robot.press(0b010)
    driven.robot.run(0.05)
    driven.balboa.select(balboa.ENCODERS)
    assert driven.balboa.fetch_motion()[0].buttons == 0b010


def test_motors_and_leds_obey_and_motors_stop_after_200_ms(driven: Driven) -> None:
    driven.balboa.write_motors(0.25, -1.0)
    driven.balboa.write_leds(True, False, True)
    driven.robot.run(0.003)
    assert driven.robot.motors() == (0.25, -1.0)
    assert driven.robot.leds() == (True, False, True)
    driven.robot.run(0.21)
    assert driven.robot.motors() == (0.0, 0.0)
    assert driven.balboa.read_housekeeping().stopped_by_watchdog


def test_each_report_is_read_once_in_slices(driven: Driven) -> None:
    driven.answers[LOC_GET.request] = encode_location(location())
    reader = UwbReader(driven.now())
    first, second = driven.until_news(reader), driven.until_news(reader)
    assert (first.sequence, second.sequence, second.lost, second.state) == (1, 2, 0, "ok")
    assert second.t - first.t == pytest.approx(0.1, abs=0.025)
    assert 0.0 <= second.age < 0.03
    assert (second.x, second.y, second.z, second.quality, second.count) == (1.234, -2.5, 0.75, 87, 4)
    for n, each in enumerate(second.ranges):
        assert (each.anchor, each.distance, each.quality) == (f"C93{n}", 1.5 + n, 80 + n)
        assert (each.x, each.y, each.z, each.place_quality) == (float(n), 2.0 * n, -0.5, 100)
    assert max(max(len(each.data), each.reads) for each in driven.transfers) <= LONGEST


def test_a_report_that_comes_between_the_slices_is_not_mixed_with_the_last(driven: Driven) -> None:
    """The module's answers change each time; the slices are ticks apart, some of them on both sides of a new one."""
    reader = UwbReader(driven.now())
    told = []
    for n in range(8):
        driven.answers[LOC_GET.request] = encode_location(location(first=0x1000 * (n + 1)))
        for _ in range(9 + n % 3):  # the phase between ticks and reports moves
            if n % 2 and reader.next(driven.now()) is not None and len(driven.transfers) % 3 == 0:
                driven.transfers.append(None)
                driven.tick()  # a tick without room
                continue
            driven.tick(reader)
            if reader.news is not None:
                told.append(reader.news)
                reader.news = None
    whole = [each for each in told if each.ranges]
    assert len(whole) >= 5
    for each in whole:
        first = int(each.ranges[0].anchor, 16)
        assert [int(other.anchor, 16) for other in each.ranges] == [first + n for n in range(4)]


@pytest.mark.parametrize(
    ("reply", "state", "error", "bad"),
    [(b"", "silent", 0, 0), (b"\x40\x01\x04", "refused", 4, 0), (b"dwm> ", "broken", 0, 5)],
    ids=["silent", "refused", "shell"],
)
def test_a_module_that_gives_no_report_is_told_each_second(driven: Driven, reply, state, error, bad) -> None:
    driven.answers[LOC_GET.request] = reply
    reader = UwbReader(driven.now())
    driven.until_news(reader)
    news = driven.until_news(reader)
    assert (news.state, news.error, news.sequence, news.ranges, news.quality) == (state, error, 0, (), 0)
    assert news.bad >= bad


def test_reports_count_on_through_a_reset_of_the_atmega(driven: Driven) -> None:
    driven.answers[LOC_GET.request] = encode_location(location())
    reader = UwbReader(driven.now())
    for sequence in range(1, 4):
        assert driven.until_news(reader).sequence == sequence
    driven.robot.reset(4)
    news = driven.until_news(reader)
    while news.state != "ok":
        news = driven.until_news(reader)
    assert (news.sequence, news.lost) == (4, 0)


@pytest.mark.parametrize(
    ("request_", "reply"),
    [
        (CFG_GET, CFG),
        (ModuleRequest("longest", b"\x99" + bytes((253,)) + bytes(range(253))), bytes.fromhex("400101")),
        (ModuleRequest("many", b"\x0c\x00"), encode_location(location(count=12))),
    ],
    ids=lambda value: getattr(value, "ticket", None),
)
def test_a_request_to_the_module_and_its_answer(driven: Driven, request_, reply) -> None:
    driven.robot.run(0.02)
    driven.robot.sent()
    mailbox = Mailbox()
    driven.answers[request_.request] = reply
    mailbox.post(request_, driven.now())
    answer = driven.until_news(mailbox)
    assert (answer.ticket, answer.answer, answer.problem) == (request_.ticket, reply, "")
    assert request_.request in driven.asked
    assert max(max(len(each.data), each.reads) for each in driven.transfers) <= LONGEST


@pytest.mark.parametrize(
    ("reply", "problem"), [(b"", "does not answer"), (b"dwm> ?", "shell mode")], ids=["silent", "shell"]
)
def test_a_request_without_an_answer_has_an_end(driven: Driven, reply, problem) -> None:
    mailbox = Mailbox()
    driven.answers[CFG_GET.request] = reply
    mailbox.post(CFG_GET, driven.now())
    answer = driven.until_news(mailbox, limit=1.5)
    assert answer.answer == reply
    assert problem in answer.problem


def test_requests_are_one_at_a_time_and_not_done_twice(driven: Driven) -> None:
    mailbox = Mailbox()
    driven.answers[CFG_GET.request] = CFG
    mailbox.post(CFG_GET, driven.now())
    mailbox.post(CFG_GET, driven.now())
    assert mailbox.news is None
    mailbox.post(ModuleRequest("other", b"\x15\x00"), driven.now())
    refusal = driven.until_news(mailbox)
    assert (refusal.ticket, refusal.answer) == ("other", b"")
    assert "under way" in refusal.problem
    answer = driven.until_news(mailbox)
    asked = driven.asked.count(CFG_GET.request)
    mailbox.post(CFG_GET, driven.now())
    assert driven.until_news(mailbox) == answer
    assert driven.asked.count(CFG_GET.request) == asked


def test_a_mailbox_left_busy_by_somebody_else_is_waited_for(driven: Driven) -> None:
    for data in (bytes((balboa.MAILBOX_PAGE, 0, 0x14, 0)), bytes((balboa.MAILBOX_TOKEN, 99, 2))):
        driven.robot.bus.write(balboa.ADDRESS, data)
        driven.robot.run(0.002)
    mailbox = Mailbox()
    driven.answers[CFG_GET.request] = CFG
    mailbox.post(CFG_GET, driven.now())
    assert driven.until_news(mailbox).answer == CFG


def test_a_reset_in_the_middle_of_a_request_is_named(driven: Driven) -> None:
    mailbox = Mailbox()
    mailbox.post(CFG_GET, driven.now())
    for _ in range(10):
        driven.tick(mailbox)
    driven.robot.reset(4)
    assert "reset" in driven.until_news(mailbox).problem


def test_health_is_read_twice_a_second_and_told_each(driven: Driven) -> None:
    health = BoardHealth(driven.now())
    told = [driven.until_news(health) for _ in range(3)]
    assert [each.voltage for each in told] == pytest.approx([7.4] * 3, abs=0.05)
    assert [b.t - a.t for a, b in itertools.pairwise(told)] == pytest.approx([1.0, 1.0], abs=0.02)


def test_a_tune_is_played_note_by_note(driven: Driven) -> None:
    player = Player()
    player.play(SetNotes((Note(440.0, 0.05, 1.0), Note(880.0, 0.05, 1.0), Note(0.0, 0.1, 1.0))), driven.now())
    left = []
    for _ in range(30):
        driven.tick(player)
        driven.balboa.select(balboa.UWB_STATE)
        left.append(balboa.decode_progress(driven.balboa._fetch(balboa.PROGRESS_SIZE)).notes_left)
    assert sorted(set(left), reverse=True) == [3, 2, 1, 0]
    assert left == sorted(left, reverse=True)
    refused = driven.balboa.read_housekeeping().refused
    assert refused == 0


# What is acknowledged, refused and read back: the firmware is the reference for the simulated device.

VOLATILE = {
    *range(balboa.ENCODERS, balboa.ENCODERS + 4),
    *range(balboa.BATTERY, balboa.BATTERY + 2),
    balboa.RESET_CAUSE,
    *range(balboa.FREE_STACK, balboa.FREE_STACK + 2),
    balboa.UWB_STATE,
}
"""What depends on the moment or the chip."""

offsets = st.sampled_from([field.offset for field in FIELDS.values()]) | st.integers(0, 255)
writes = st.tuples(offsets, st.binary(max_size=36)).filter(lambda item: item[0] != balboa.COMMAND)


def outcome(driven: Driven, data: bytes) -> bool:
    try:
        driven.robot.bus.write(balboa.ADDRESS, data)
    except OSError:
        return False
    finally:
        driven.robot.run(2e-4)
    return True


def buffer(driven: Driven) -> dict[int, int]:
    driven.robot.bus.write(balboa.ADDRESS, b"\0")
    driven.robot.run(2e-4)
    data = driven.robot.bus.read(balboa.ADDRESS, 256)
    driven.robot.run(2e-4)
    return {at: value for at, value in enumerate(data) if at not in VOLATILE}


def joined(driven: Driven, index: int, count: int) -> tuple[balboa.MotionBlock, bytes]:
    driven.balboa.select(index)
    return driven.balboa.fetch_motion(count)


def test_a_piece_of_a_report_comes_with_the_encoders_and_the_next_one_goes_on(driven: Driven) -> None:
    """Pieces of any size are of the report of the first one, though others came meanwhile, and other reads."""
    driven.answers[LOC_GET.request] = encode_location(location())
    for _ in range(15):
        driven.tick()
    _, block = joined(driven, balboa.joined(balboa.UWB), 5)
    driven.answers[LOC_GET.request] = encode_location(location(first=0x1000))
    for size in (3, 1, 7, 16, 14):
        for _ in range(4):
            driven.tick()
        driven.balboa.read_housekeeping()
        motion, more = joined(driven, balboa.ONWARD, size)
        block += more
    assert motion.newest_report > 1, "others came"
    expected = encode_location(location())
    ranges = b"".join(expected[21 + 20 * n : 28 + 20 * n] for n in range(4))
    assert block[0:2] == b"\1\0"
    assert block[4:46] == expected[20:21] + expected[5:18] + ranges
    _, again = joined(driven, balboa.joined(balboa.UWB), 2)
    assert again[0] == motion.newest_report


def test_every_joined_index_goes_on_at_its_offset(driven: Driven) -> None:
    driven.answers[LOC_GET.request] = encode_location(location())
    for _ in range(15):
        driven.tick()
    plain = {}
    for offset in (balboa.BUTTONS, balboa.UWB):  # the second one freezes the report
        driven.balboa.select(offset)
        for at, value in enumerate(driven.balboa._fetch(132 - offset), offset):
            plain[at] = value
    for offset in range(balboa.BUTTONS, balboa.LAST_JOINED + 1, 4):
        if offset == balboa.UWB:
            continue
        _, more = joined(driven, balboa.joined(offset), 8)
        steady = [at for at in range(offset, offset + 8) if at not in VOLATILE and at != balboa.STATUS]
        assert [more[at - offset] for at in steady] == [plain[at] for at in steady], offset


def test_the_simulated_atmega_has_the_same_room_at_every_offset(new_bench) -> None:
    """Zeros: no request is sent to the module by them, no tune is played."""
    real, simulated = Driven(Real(new_bench())), Driven(Simulated())
    for offset in range(256):
        for size in (1, 2, 3, 4, 7, 8, 28, 29, 30, 31, 32):
            written = bytes((offset,)) + bytes(size)
            assert outcome(simulated, written) == outcome(real, written), (offset, size)
    assert buffer(simulated) == buffer(real)


@given(done=st.lists(writes, max_size=6))
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=examples(40), deadline=None)
def test_the_simulated_atmega_takes_and_refuses_what_the_firmware_does(new_bench, done) -> None:
    real, simulated = Driven(Real(new_bench())), Driven(Simulated())
    for offset, data in done:
        written = bytes((offset,)) + data
        assert outcome(simulated, written) == outcome(real, written), written.hex(" ")
    assert buffer(simulated) == buffer(real)
