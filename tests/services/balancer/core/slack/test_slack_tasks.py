"""Slack tasks in virtual time: what is told when, and that no tick suffers."""

import errno
import logging
import random

import pytest
from hypothesis import given
from hypothesis import strategies as st
from slack_rig import AT_100_KHZ, Ticking

from services.balancer.core.control.lqr import PERIOD_S
from services.balancer.core.devices import balboa, health, uwb
from services.balancer.core.devices.buttons import ButtonCounter
from services.balancer.core.devices.display import ScreenText
from services.balancer.core.devices.mailbox import check_request
from services.balancer.core.devices.requests import check
from services.balancer.core.slack.transfers import read
from services.balancer.core.slack.wire_time import Transfer
from services.balancer.slack_tasks import MARGIN_S, SLACK_S
from services.dwm.core.module.tlv import LOC_GET, AnchorRange, Location, Position, encode_location
from swarm.errors import LocalError, RemoteError
from swarm.messages import (
    Battery,
    Buttons,
    Display,
    ImuRequest,
    ImuSample,
    ModuleAnswer,
    ModuleRequest,
    Note,
    SetDisplay,
    SetNotes,
    Uwb,
)


def test_no_tick_has_more_than_its_share() -> None:
    ticking = Ticking().run(1.0)
    ticking.tasks.obey(ModuleRequest("long", b"\x99\xfd" + bytes(253)), ticking.rig.now)
    ticking.tasks.obey(ScreenText(tuple("abcdefghijklmnopqrstu" for _ in range(7))), ticking.rig.now)
    ticking.tasks.obey(SetNotes((Note(440.0, 0.1, 1.0),) * 64), ticking.rig.now)
    ticking.run(3.0)
    spent: dict[int, float] = {}
    for tick, transfer in ticking.transfers:
        spent[tick] = spent.get(tick, 0.0) + AT_100_KHZ.duration(transfer)
    assert max(spent.values()) <= SLACK_S
    assert len(ticking.transfers) > 150
    assert ticking.rig.balancer.mode == "balancing"
    assert ticking.tasks.errors == 0


def test_a_late_tick_does_nothing_that_would_make_the_next_one_late() -> None:
    ticking = Ticking().run(1.0)
    before = len(ticking.transfers)
    for _ in range(50):
        ticking.rig.now += PERIOD_S
        assert not [each for each in ticking.tasks.run(ticking.rig.now + MARGIN_S) if not isinstance(each, Buttons)]
    assert len(ticking.transfers) == before


def test_the_longest_slice_fits_the_slack() -> None:
    assert AT_100_KHZ.duration(read(balboa.UWB, 32)) <= SLACK_S


def test_the_battery_is_published_each_second() -> None:
    ticking = Ticking().run(3.5)
    told = ticking.of(Battery)
    assert [each.voltage for each in told] == [7.4] * 4
    ticking.robot.atmega.battery = 6.9
    ticking.run(1.0)
    assert ticking.of(Battery)[-1].voltage == 6.9
    assert ticking.rig.balancer.battery == 6.9


def test_a_battery_that_is_not_read_any_more_has_no_voltage(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its transfers fail, and those of the control loop do not: the last voltage counts for a time only."""
    monkeypatch.setattr(health, "UNKNOWN_S", 3.0)
    ticking = Ticking().run(1.0)
    driver, balancer = ticking.rig.balancer.balboa, ticking.rig.balancer
    transfer = driver.transfer

    def failing(each: Transfer) -> bytes:
        if each.data[0] == balboa.BUTTONS:
            raise OSError(121, "Remote I/O error", "atmega")
        return transfer(each)

    driver.transfer = failing
    ticking.run(2.0)
    assert balancer.battery == 7.4
    ticking.run(1.5)
    assert balancer.battery is None
    assert balancer.connected
    driver.transfer = transfer
    ticking.run(0.6)
    assert balancer.battery == 7.4


def test_what_the_firmware_noticed_is_told_once() -> None:
    ticking = Ticking().run(2.0)
    ticking.robot.atmega._buffer[balboa.BUS_RESETS] = 3
    ticking.robot.atmega._buffer[balboa.ENCODER_ERRORS] = 1
    ticking.run(2.0)
    assert [text for about, text in ticking.rig.balancer.notices if about == "board"] == [
        "encoders: both channels changed at once, left and right (1, 0)",
        "the ATmega dropped a transfer that had stopped in the middle, 3 so far",
    ]


def test_every_press_is_told_and_counted() -> None:
    ticking = Ticking().run(0.1)
    for down in (1, 0, 1, 3, 2, 0, 4, 0):
        ticking.robot.atmega.press(down)
        ticking.run(PERIOD_S)
    told = ticking.of(Buttons)[-8:]
    assert [(each.a, each.b, each.c) for each in told[:5]] == [
        (True, False, False),
        (False, False, False),
        (True, False, False),
        (True, True, False),
        (False, True, False),
    ]
    assert (told[-1].presses_a, told[-1].presses_b, told[-1].presses_c) == (2, 1, 1)


@given(st.lists(st.integers(0, 7), max_size=50))
def test_presses_are_the_rising_edges(downs: list[int]) -> None:
    counter = ButtonCounter()
    last, edges = 0, [0, 0, 0]
    told = Buttons(0.0, False, False, False, 0, 0, 0)
    for n, down in enumerate(downs):
        told = counter.update(down, 100.0 + n * 0.01) or told
        for bit in range(3):
            edges[bit] += bool(down >> bit & 1) and not last >> bit & 1
        last = down
        assert [told.a, told.b, told.c] == [bool(down >> bit & 1) for bit in range(3)]
    assert [told.presses_a, told.presses_b, told.presses_c] == edges


def test_imu_samples_as_long_as_asked_for() -> None:
    ticking = Ticking().run(4.0)
    assert ticking.of(ImuSample) == []
    ticking.tasks.obey(ImuRequest(100.0, 0.5), ticking.rig.now)
    ticking.run(1.0)
    told = ticking.of(ImuSample)
    assert [each.sequence for each in told] == list(range(1, len(told) + 1))
    assert 49 <= len(told) <= 51
    assert told[-1].acceleration[0] == pytest.approx(9.8, abs=0.5)
    assert len(told[-1].gyro) == 3
    ticking.tasks.obey(ImuRequest(10.0, 60.0), ticking.rig.now)
    ticking.run(1.0)
    assert 9 <= len(ticking.of(ImuSample)) - len(told) <= 11
    ticking.tasks.obey(ImuRequest(10.0, 0.0), ticking.rig.now)
    count = len(ticking.of(ImuSample))
    ticking.run(1.0)
    assert len(ticking.of(ImuSample)) == count


def test_the_display_shows_and_tells_what_it_was_given() -> None:
    ticking = Ticking().run(0.2)
    ticking.tasks.obey(ScreenText(("r0", "balancing")), ticking.rig.now)
    ticking.run(2.0)
    assert [(each.present, each.lines) for each in ticking.of(Display)][-1] == (True, ("r0", "balancing"))
    assert "#" in "".join(ticking.robot.display.picture())
    assert set("".join(ticking.robot.display.picture()[24:])) == {"."}


def test_a_robot_without_a_display_is_a_whole_robot(caplog: pytest.LogCaptureFixture) -> None:
    ticking = Ticking()
    del ticking.robot.devices[0x3C]
    with caplog.at_level(logging.INFO):
        ticking.run(25.0)
    assert [(each.present, each.lines) for each in ticking.of(Display)] == [(False, ())]
    assert caplog.text.count("display not there (0x3C)") == 1
    assert ("display", "not there (0x3C): nothing is shown") in ticking.rig.balancer.notices
    assert (ticking.tasks.errors, ticking.rig.balancer.mode, ticking.rig.balancer.fault) == (0, "balancing", None)


def test_failures_of_chores_are_counted_and_logged_now_and_then(caplog: pytest.LogCaptureFixture) -> None:
    ticking = Ticking().run(4.0)

    def fail(transfer: Transfer) -> bytes:
        raise OSError(121, "Remote I/O error")

    ticking.rig.balancer.balboa.transfer = fail
    ticking.run(5.0)
    assert ticking.tasks.errors > 20
    assert 1 <= caplog.text.count("Remote I/O error") <= 2
    assert ticking.rig.balancer.mode == "balancing"


def test_nonsense_from_the_atmega_is_an_error_and_no_news(caplog: pytest.LogCaptureFixture) -> None:
    ticking = Ticking().run(4.0)
    ticking.news.clear()
    ticking.rig.balancer.balboa.transfer = lambda transfer: bytes((99,)) * transfer.reads
    ticking.run(2.0)
    assert ticking.of(Uwb) == []
    assert ticking.tasks.errors > 0
    assert "there is none" in caplog.text or "quality" in caplog.text


def test_a_request_while_the_devices_are_away_has_an_end() -> None:
    ticking = Ticking().run(4.0)
    ticking.robot.devices.pop(balboa.ADDRESS)
    ticking.run(1.0)
    ticking.tasks.obey(ModuleRequest("mine", b"\x08\x00"), ticking.rig.now)
    ticking.run(3.5)
    assert [(each.ticket, each.problem) for each in ticking.of(ModuleAnswer)] == [("mine", "no answer within 3 s")]


def test_a_clock_that_goes_back_stops_no_chore_for_good() -> None:
    ticking = Ticking().run(4.0)
    ticking.rig.now -= 3.0
    ticking.rig.deadline -= 3.0
    ticking.run(2.0)
    ticking.news.clear()
    ticking.run(3.0)
    assert ticking.of(Battery)
    assert ticking.of(Uwb)
    assert ticking.tasks.errors == 0


@pytest.mark.parametrize("seed", range(4))
def test_requests_and_reports_come_through_a_bus_with_failures(seed: int) -> None:
    """One transfer in ten fails; what is told is whole all the same."""
    chance = random.Random(seed)
    ticking = Ticking().run(4.0)
    line, reply = ticking.robot.atmega.line, bytes.fromhex("400100 46025010")
    told = 0
    for number in range(3):
        request = b"\x99\xc8" + bytes((number,)) * 200
        ticking.tasks.obey(ModuleRequest(str(number), request), ticking.rig.now)
        for _ in range(320):
            ticking.robot.failures = [errno.EREMOTEIO if chance.random() < 0.1 else 0 for _ in range(20)]
            ticking.run(PERIOD_S)
            sent = line.to_send()
            if sent == request:
                line.receive(reply, ticking.rig.now)
            elif sent == LOC_GET.request:
                line.receive(encode_location(location(told)), ticking.rig.now)
                told += 1
    ticking.robot.failures = []
    assert [(each.ticket, each.answer, each.problem) for each in ticking.of(ModuleAnswer)] == [
        (str(number), reply, "") for number in range(3)
    ]
    reports = [each for each in ticking.of(Uwb) if each.ranges]
    assert len({each.sequence for each in reports}) > 80
    for each in reports:
        assert len({round(found.distance - n, 3) for n, found in enumerate(each.ranges)}) == 1, "of one report"
    assert reports[-1].sequence + reports[-1].lost in range(told - 2, told + 1)


def location(number: int) -> Location:
    """All of it tells the number."""
    ranges = (AnchorRange(f"{n:04X}", n + number / 100, 90, Position(0.0, 0.0, 0.0, 100)) for n in range(4))
    return Location(Position(number / 100, 0.0, 0.0, 90), tuple(ranges))


@given(st.binary(max_size=110))
def test_any_block_is_decoded_or_refused(block: bytes) -> None:
    try:
        if uwb.check(block):
            found = uwb.decode(block, 1.0, 0, 1, 0)
            assert len(found.ranges) == min(found.count, 4)
            assert all(0 <= each.quality <= 100 for each in found.ranges)
    except RemoteError:
        pass


@pytest.mark.parametrize(
    ("command", "reason"),
    [
        (ModuleRequest("t", b"\x0c"), "1 bytes, expected 2 to 255"),
        (ModuleRequest("t", b"\x0c\x01"), "a value of 0 bytes, its length says 1"),
        (ModuleRequest("t", bytes(256)), "256 bytes"),
        (ModuleRequest("t" * 65, b"\x0c\x00"), "ticket of 65"),
        (ModuleRequest("t", b"\x13\x00"), "request 13 00: not one of the calls that are let through"),
        (ImuRequest(0.0, 1.0), "rate: 0 Hz"),
        (ImuRequest(101.0, 1.0), "rate: 101 Hz, expected 0.01 to 100"),
        (ImuRequest(50.0, 61.0), "duration: 61 s"),
        (ImuRequest(50.0, -1.0), "duration: -1 s"),
        (SetNotes((Note(1.0, 1.0, 1.0),)), "frequency: 1 Hz"),
        (SetDisplay("x" * 201), "201 letters"),
    ],
)
def test_commands_out_of_range_are_refused(command: object, reason: str) -> None:
    with pytest.raises(LocalError, match=reason):
        check(command)


@given(st.binary(max_size=300), st.text(max_size=70))
def test_a_request_that_passes_has_the_length_it_says(request: bytes, ticket: str) -> None:
    try:
        check_request(ModuleRequest(ticket, request))
    except LocalError:
        return
    assert len(request) == 2 + request[1]
