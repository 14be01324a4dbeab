from itertools import pairwise

import pytest
from dwm_frames import GOLDEN, LOCATION
from hypothesis import given
from hypothesis import strategies as st

from services.dwm.core.poller import FAILURES, MAX_PAUSE, TIMEOUT, Health, Poller, Report
from services.dwm.core.tlv import encode_refusal


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
        first = [Health(True, "")] if index == 0 else []
        assert poller.events() == [*first, Report(LOCATION)]


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
    ask(poller, poller.next_deadline())
    poller.receive(GOLDEN, poller.next_deadline() - 0.05)
    assert poller.events() == [Health(True, ""), Report(LOCATION)]


@pytest.mark.parametrize(
    ("answer", "words"),
    [
        (encode_refusal(4), "refuses loc_get: busy"),
        (encode_refusal(1), "unknown call or broken frame"),
        (b"dwm> ", "garbled"),
        (GOLDEN[:40], "garbled"),
        (GOLDEN[:3] + b"\x48" + GOLDEN[4:], "part of type 48"),
    ],
)
def test_trouble_is_named(answer, words):
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
    poller.receive(GOLDEN[:3] + b"\x48" + GOLDEN, 0.02)
    assert poller.events() == [Health(True, ""), Report(LOCATION)]
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
            assert request == b"\x0c\x00"
            sent.append(now)
        poller.events()
    assert all(b - a >= 0.1 - 1e-9 or poller.counters for a, b in pairwise(sent))
