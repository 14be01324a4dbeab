from itertools import pairwise

import pytest
from dwm_frames import GOLDEN, LOCATION
from hypothesis import given
from hypothesis import strategies as st

from services.dwm.core.module.calls import CFG_GET, RESET, VER_GET
from services.dwm.core.module.exchange import RESTART, SLOW_TIMEOUT, TIMEOUT
from services.dwm.core.module.poller import (
    FAILURES,
    MAX_PAUSE,
    MAX_WAITING,
    Answered,
    ModuleHealth,
    ModuleReport,
    Poller,
)
from services.dwm.core.module.shell import LEAVE
from services.dwm.core.module.tlv import LOC_GET, encode_refusal


def ask(poller, now):
    """Let the request that is due go out."""
    poller.handle_timer(now)
    assert poller.to_send() == b"\x0c\x00"


def fail(poller, count, answer=b""):
    """Requests that end without a report; gives when they were sent."""
    sent = []
    while len(sent) < count:
        now = poller.next_deadline()
        poller.handle_timer(now)
        if poller.to_send():
            sent.append(now)
            if answer:
                poller.receive(answer, now + 0.02)
    poller.handle_timer(sent[-1] + TIMEOUT)
    return sent


def test_asks_at_the_rate_and_reports():
    poller = Poller(10.0, 5.0)
    for index in range(5):
        assert poller.next_deadline() == pytest.approx(5.0 + 0.1 * index)
        ask(poller, 5.0 + 0.1 * index)
        assert poller.next_deadline() == pytest.approx(5.0 + 0.1 * index + TIMEOUT)
        poller.receive(GOLDEN[:30], 5.01 + 0.1 * index)
        assert poller.events() == []
        poller.receive(GOLDEN[30:], 5.02 + 0.1 * index)
        first = [ModuleHealth(True, "")] if index == 0 else []
        assert poller.events() == [*first, ModuleReport(LOCATION)]


def test_never_faster_than_the_module():
    poller = Poller(50.0, 0.0)
    ask(poller, 0.0)
    poller.receive(GOLDEN, 0.01)
    assert poller.next_deadline() == pytest.approx(0.1)


def test_does_not_catch_up_after_a_stall():
    poller = Poller(10.0, 0.0)
    ask(poller, 0.0)
    poller.receive(GOLDEN, 0.01)
    ask(poller, 7.0)
    poller.receive(GOLDEN, 7.01)
    assert poller.next_deadline() == pytest.approx(7.1)


def test_one_request_at_a_time():
    poller = Poller(10.0, 0.0)
    ask(poller, 0.0)
    poller.handle_timer(0.05)
    assert poller.to_send() == b""
    assert poller.next_deadline() == pytest.approx(TIMEOUT)


def test_a_late_answer_is_not_taken_for_the_next():
    poller = Poller(2.0, 0.0)
    ask(poller, 0.0)
    poller.handle_timer(TIMEOUT)
    poller.receive(GOLDEN, 0.15)
    assert poller.events() == []
    assert poller.counters == {"silent": 1, "unasked": 1}


def test_a_silent_module_is_told_once_and_asked_ever_more_rarely_for_ever():
    poller = Poller(10.0, 0.0)
    sent = fail(poller, 20)
    (health,) = poller.events()
    assert not health.working
    assert "does not answer" in health.reason
    assert poller.counters == {"silent": 20}
    pauses = [round(b - a, 6) for a, b in pairwise(sent)]
    assert pauses == sorted(pauses)
    assert pauses[-1] == pytest.approx(MAX_PAUSE + TIMEOUT)
    while poller.to_send() != LOC_GET.request:
        poller.handle_timer(poller.next_deadline())
    poller.receive(GOLDEN, poller.next_deadline() - 0.05)
    assert poller.events() == [ModuleHealth(True, ""), ModuleReport(LOCATION)]


def test_a_module_that_stays_in_its_shell_is_told_to_leave_it():
    poller, asked = Poller(10.0, 0.0), []
    while len(asked) < 12:
        poller.handle_timer(poller.next_deadline())
        if request := poller.to_send():
            asked.append(request)
            poller.receive(
                b"\r\ndwm> " if asked.count(LEAVE) < 2 or request == LEAVE else GOLDEN, poller.next_deadline() - 0.05
            )
    assert asked[:7] == [LOC_GET.request] * FAILURES + [LEAVE] * 2 + [LOC_GET.request] * 2
    events = poller.events()
    assert "shell mode" in events[0].reason
    assert events[1:3] == [ModuleHealth(True, ""), ModuleReport(LOCATION)]


def test_a_module_that_is_in_no_shell_is_not_blamed_for_its_answer_to_quit():
    poller, asked = Poller(10.0, 0.0), []
    while len(asked) < 12:
        poller.handle_timer(poller.next_deadline())
        if request := poller.to_send():
            asked.append(request)
            if request == LEAVE:
                poller.receive(encode_refusal(1), poller.next_deadline() - 0.05)
    assert asked.count(LEAVE) == 3
    assert ["does not answer" in health.reason for health in poller.events()] == [True]
    assert poller.counters == {"silent": 8}  # the twelfth is under way


def test_requests_of_others_go_between_two_polls():
    poller = Poller(10.0, 0.0)
    ask(poller, 0.0)
    poller.ask("a", VER_GET.request)
    assert poller.to_send() == b""  # one at a time
    poller.receive(GOLDEN, 0.02)
    poller.handle_timer(poller.next_deadline())
    assert poller.to_send() == VER_GET.request
    raw = bytes.fromhex("400100 5004 01000301 5104 00070100 5204 2a00cade")
    poller.receive(raw[:7], 0.03)
    poller.receive(raw[7:], 0.04)
    assert poller.events() == [ModuleHealth(True, ""), ModuleReport(LOCATION), Answered("a", raw, "")]
    assert poller.next_deadline() == pytest.approx(0.1)
    ask(poller, 0.1)


def test_what_becomes_of_requests_that_get_no_answer():
    poller = Poller(10.0, 0.0)
    poller.ask("refused", CFG_GET.request)
    poller.ask("silent", CFG_GET.request)
    poller.ask("forbidden", b"\x13\x00")
    poller.handle_timer(poller.next_deadline())
    poller.receive(encode_refusal(5), 0.1)
    poller.handle_timer(0.1)
    assert poller.next_deadline() == pytest.approx(0.1 + SLOW_TIMEOUT)
    poller.handle_timer(poller.next_deadline())
    forbidden, refused, silent = poller.events()
    assert "not one of the calls" in forbidden.problem
    assert refused == Answered("refused", encode_refusal(5), "")
    assert (silent.answer, "does not answer" in silent.problem) == (b"", True)
    for number in range(MAX_WAITING + 1):
        poller.ask(str(number), CFG_GET.request)
    (last,) = poller.events()
    assert (last.ticket, "ask again" in last.problem) == (str(MAX_WAITING), True)


def test_a_reset_leaves_the_module_time_to_come_back():
    poller = Poller(10.0, 0.0)
    poller.ask("reset", RESET.request)
    poller.handle_timer(0.0)
    assert poller.to_send() == RESET.request
    poller.receive(encode_refusal(0), 0.01)
    assert poller.events() == [Answered("reset", encode_refusal(0), "")]
    assert poller.next_deadline() == pytest.approx(0.01 + RESTART)
    ask(poller, poller.next_deadline())


@pytest.mark.parametrize(
    ("answer", "words"),
    [
        (encode_refusal(4), "refuses loc_get: busy"),
        (encode_refusal(1), "unknown call or broken frame"),
        (b"dwm> ", "shell mode"),
        (GOLDEN[:40], "garbled"),
        (bytes(range(128, 200)), "wrong baud rate"),
        # LEAPS' newer firmware: time stamp (4 bytes) and flags before the count of ranges
        (GOLDEN[:18] + b"\x49\x56" + bytes(5) + GOLDEN[20:], "another layout (loc_get: part 49 of 86 bytes"),
        (GOLDEN[:3] + b"\x47" + GOLDEN[4:], "another layout (loc_get: part of type 47"),
    ],
)
def test_the_poller_names_the_trouble_after_three_failures(answer, words):
    poller = Poller(10.0, 0.0)
    fail(poller, FAILURES - 1, answer)
    assert poller.events() == []
    poller = Poller(10.0, 0.0)
    fail(poller, FAILURES, answer)
    (health,) = poller.events()
    assert not health.working
    assert words in health.reason


def test_an_answer_after_a_wrong_frame_counts():
    poller = Poller(10.0, 0.0)
    ask(poller, 0.0)
    poller.receive(GOLDEN[:3] + b"\x47" + GOLDEN, 0.02)
    assert poller.events() == [ModuleHealth(True, ""), ModuleReport(LOCATION)]
    assert poller.counters == {"wrong_frames": 1}


@given(st.lists(st.tuples(st.floats(0, 0.3), st.sampled_from([b"", GOLDEN, GOLDEN[:9], b"\x40\x01\x04", b"\x40"]))))
def test_any_course_keeps_the_rules(course):
    poller = Poller(10.0, 0.0)
    now, sent = 0.0, []
    for pause, data in course:
        now += pause
        if data:
            poller.receive(data, now)
        if now >= poller.next_deadline():
            poller.handle_timer(now)
            assert poller.next_deadline() > now
        if request := poller.to_send():
            assert request in (b"\x0c\x00", LEAVE)
            sent.append(now)
        poller.events()
    assert all(at >= 0.1 * number - 1e-9 for number, at in enumerate(sent))
