"""The simulated module byte for byte, in virtual time: what a robot's end of the line sees, and when."""

import random

import pytest
from dwm_frames import EMPTY, LOCATION
from hypothesis import given
from hypothesis import strategies as st

from services.dwm.core.module import calls, shell
from services.dwm.core.module.calls import Settings, UpdateRate
from services.dwm.core.module.tlv import LOC_GET, AnchorRange, Location, Position, TlvDecoder, encode_location
from sim.core.dwm1001 import (
    BYTE,
    JOINING,
    LATENCY,
    READY_RATE,
    REQUEST_GAP,
    RESTART,
    STILL_AFTER,
    Dwm1001,
    Flash,
)
from swarm.errors import FrameError

IDENTITY = 0xDECA9AABC0A2DE01
FACTORY_RATE = UpdateRate(1, 100)
TAG, ANCHOR = Settings(anchor=False), Settings(anchor=True, initiator=True)


class Line:
    """A module and the clock; time passes from event to event."""

    def __init__(self, settings=TAG, rate=READY_RATE, place=EMPTY.position, measure=lambda: LOCATION):
        self.now, self.measured = 0.0, []

        def measuring():
            self.measured.append(self.now)
            return measure()

        flash = Flash(settings, rate, place)
        self.module = Dwm1001(IDENTITY, flash, random.Random(1), measuring, self.now, chunk=8)
        self.arrived: list[tuple[float, bytes]] = []

    def run(self, seconds):
        """Let time pass; gives what came meanwhile."""
        end, start = self.now + seconds, len(self.arrived)
        while (deadline := max(self.now, self.module.next_deadline())) <= end:
            self.now = deadline
            self.module.handle_timer(self.now)
            if data := self.module.to_send(self.now):
                self.arrived.append((self.now, data))
        self.now = end
        return b"".join(data for _, data in self.arrived[start:])

    def send(self, data, seconds=0.05):
        self.module.receive(data, self.now)
        return self.run(seconds)

    def ask(self, call):
        decoder = TlvDecoder(call)
        decoder.receive(self.send(call.request))
        return decoder.next()

    def enter(self):
        assert b"dwm>" in self.send(b"\r\r")


def test_an_answer_takes_its_latency_and_its_bytes_their_time():
    line = Line()
    line.run(0.3)
    for _ in range(40):
        asked = line.now
        assert line.send(LOC_GET.request, 0.1) == encode_location(LOCATION)
        pieces = line.arrived[-13:]
        assert [len(data) for _, data in pieces] == [8] * 12 + [5]
        assert LATENCY[0] + 8 * BYTE <= pieces[0][0] - asked <= LATENCY[1] + 8 * BYTE
        assert pieces[-1][0] - pieces[0][0] == pytest.approx(93 * BYTE)
    assert pytest.approx(0.0088, abs=1e-4) == 101 * BYTE


def test_a_request_ends_at_the_gap():
    line = Line()
    line.run(0.3)
    assert line.send(b"\x0c", REQUEST_GAP * 0.9) == b""
    assert line.send(b"\x00") == encode_location(LOCATION)
    assert line.send(b"\x0c", REQUEST_GAP * 1.1) == b""
    assert line.send(b"\x00") == bytes.fromhex("400101 400101")


def test_several_requests_in_one_piece_are_answered_one_after_the_other():
    line = Line()
    assert line.send(calls.STATUS_GET.request + calls.NODE_ID_GET.request) == bytes.fromhex(
        "400100 5a02 0200 400100 4e08 01dea2c0ab9acade"
    )


@pytest.mark.parametrize("request_", ["63 00", "0c 01 03", "13 00", "05 01 5a", "68 65 6c 6c 6f"])
def test_unknown_calls_and_broken_frames_are_refused(request_):
    assert Line().send(bytes.fromhex(request_)) == bytes.fromhex("400101")


@pytest.mark.parametrize(
    "request_", ["03 04 0000 0100", "03 04 0100 5902", "05 02 5b 00", "05 02 5a 01", "07 02 03 00",
                 "01 0d 00000000 00000000 00000000 65"]
)  # fmt: skip
def test_bad_parameters_are_refused(request_):
    assert Line().send(bytes.fromhex(request_)) == bytes.fromhex("400103")


def test_the_simulated_module_answers_every_call():
    line = Line()
    line.run(0.2)
    assert line.ask(LOC_GET) == LOCATION
    assert line.ask(calls.POS_GET) == LOCATION.position
    assert line.ask(calls.CFG_GET) == TAG
    assert line.ask(calls.UPD_RATE_GET) == UpdateRate(1, 1)
    assert line.ask(calls.upd_rate_set(UpdateRate(2, 50))) is None
    assert line.ask(calls.UPD_RATE_GET) == UpdateRate(2, 50)
    assert line.ask(calls.VER_GET).text == "1.3.0"
    assert line.ask(calls.NODE_ID_GET) == IDENTITY
    assert line.module.address == "DE01"
    line.run(0.3)
    assert line.ask(calls.STATUS_GET).located
    line.ask(calls.upd_rate_set(UpdateRate(100, 100)))
    line.ask(LOC_GET)
    assert not line.ask(calls.STATUS_GET).located


def test_settings_are_in_force_after_a_reset_which_takes_a_second():
    line = Line()
    line.run(0.2)
    assert line.ask(calls.cfg_set(ANCHOR)) is None
    assert line.ask(calls.pos_set(Position(1.0, 2.0, 0.5, 100))) is None
    assert line.ask(calls.CFG_GET) == TAG
    asked = line.now
    assert line.ask(calls.RESET) is None
    while line.send(calls.STATUS_GET.request, 0.05) == b"":
        pass
    assert line.now - asked == pytest.approx(RESTART, abs=0.15)
    assert not line.ask(calls.STATUS_GET).joined
    line.run(JOINING)
    assert line.ask(calls.STATUS_GET).joined
    settings = line.ask(calls.CFG_GET)
    assert (settings.anchor, settings.initiator) == (True, True)
    assert line.module.is_ranged(line.now)
    assert line.ask(calls.POS_GET) == Position(1.0, 2.0, 0.5, 100)


def test_an_anchor_tells_ranges_only_after_the_phone_apps_survey():
    line = Line(ANCHOR, place=Position(1.0, 2.0, 0.5, 100))
    assert line.ask(LOC_GET) == Location(Position(1.0, 2.0, 0.5, 100), ())
    line.module.survey = (AnchorRange("D002", 1.94, 100, EMPTY.position),)
    assert line.ask(LOC_GET).ranges == line.module.survey
    assert line.measured == []


@pytest.mark.parametrize("settings", [Settings(anchor=False, uwb=0), Settings(anchor=False, uwb=1)])
def test_a_module_that_is_not_active_ranges_nobody(settings):
    line = Line(settings)
    assert line.run(1.0) == b""
    assert line.ask(LOC_GET) == EMPTY
    assert not line.module.is_ranged(line.now)


def test_without_its_engine_it_knows_no_place():
    line = Line(Settings(anchor=False, engine=False))
    line.run(0.2)
    assert line.ask(LOC_GET) == Location(EMPTY.position, LOCATION.ranges)


def periods(line):
    return {round(b - a, 6) for a, b in zip(line.measured, line.measured[1:], strict=False)}


def test_a_module_measures_at_its_rate_and_holds_the_result():
    line = Line(rate=UpdateRate(3, 100))
    line.run(5.0)
    assert periods(line) == {0.3}


def test_as_it_comes_it_measures_every_10_s_when_it_stands_still():
    line = Line(Settings(anchor=False, stationary=True), FACTORY_RATE)
    line.run(STILL_AFTER - 0.01)
    assert periods(line) == {0.1}
    line.run(30.0)
    assert 10.0 in periods(line)
    del line.measured[:]
    for _ in range(20):  # it moves again
        line.module.moved(line.now)
        line.run(0.1)
    assert len(line.measured) >= 19


def test_a_balanced_robot_gets_10_hz_once_it_is_configured():
    for settings, rate in ((TAG, FACTORY_RATE), (Settings(anchor=False, stationary=True), UpdateRate(1, 1))):
        line = Line(settings, rate)
        line.run(20.0)
        assert periods(line) == {0.1}


def test_a_late_owner_does_not_get_measurements_in_a_heap():
    line = Line()
    line.module.handle_timer(7.0)
    line.module.handle_timer(7.0)
    assert len(line.measured) == 1


def test_two_returns_within_a_second_enter_the_shell():
    line = Line()
    assert line.send(b"\r") == bytes.fromhex("400101")
    assert b"dwm> " in line.send(b"\r")
    line = Line()
    line.send(b"\r", 1.1)
    assert line.send(b"\r") == bytes.fromhex("400101")
    assert b"dwm> " in line.send(b"\r")
    assert b"dwm> " in Line().send(b"\r\r")


def test_text_in_generic_mode_is_answered_by_a_refusal():
    assert Line().send(b"lec\r") == bytes.fromhex("400101")


def test_the_shell_takes_requests_for_typing_and_is_left_by_quit():
    line = Line()
    line.enter()
    assert b"unknown command" in line.send(LOC_GET.request * 3 + b"\r")
    line.send(shell.LEAVE)
    assert line.ask(calls.UPD_RATE_GET) == UpdateRate(1, 1)


def test_in_shell_mode_there_is_no_binary_traffic():
    line = Line()
    line.enter()
    assert b"\x40\x01" not in line.send(LOC_GET.request)
    assert b"dwm>" in line.send(b"\r")
    assert line.send(calls.RESET.request, 2.0) == b""


@given(st.lists(st.tuples(st.binary(max_size=12), st.floats(0, 1.5)), max_size=12), st.booleans())
def test_whatever_is_sent_it_lives(sent, shell_first):
    line = Line()
    if shell_first:
        line.enter()
    for data, pause in sent:
        line.send(data, pause)
    line.run(2.0)
    line.send(b"\r")
    line.send(shell.LEAVE)
    line.run(2.0)
    decoder = TlvDecoder(LOC_GET)
    decoder.receive(line.send(LOC_GET.request, 0.1))
    answers = []
    while LOCATION not in answers:
        try:
            answers.append(decoder.next())
        except FrameError:
            continue
        assert answers[-1] is not None
