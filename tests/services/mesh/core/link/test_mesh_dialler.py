"""Who dials whom, and when a neighbour is dialled again."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.mesh.core.link.calls import EAGER_S, FIRST_DELAY, LONGEST_DELAY, SHARE, Dialler, dials
from swarm.config.types import RobotConfig


def test_the_lower_address_dials_else_the_lower_name() -> None:
    low, high = "0A:00:00:00:00:01", "b8:27:EB:00:00:00"
    assert dials(RobotConfig("r9", bluetooth=low), RobotConfig("r1", bluetooth=high))
    assert not dials(RobotConfig("r1", bluetooth=high), RobotConfig("r9", bluetooth=low))
    assert dials(RobotConfig("r1", bluetooth=high), RobotConfig("r9"))
    assert not dials(RobotConfig("r9"), RobotConfig("r1", bluetooth=high))


@given(st.lists(st.floats(0.0, 1.0, exclude_max=True), min_size=10, max_size=10))
def test_the_back_off_doubles_with_jitter_up_to_its_limit(draws: list[float]) -> None:
    numbers = iter(draws)
    dialler = Dialler(lambda: next(numbers))
    now = 0.0
    assert dialler.take(now)
    assert not dialler.take(now)
    for attempt in range(10):
        dialler.ended(now)
        deadline = dialler.next_deadline()
        assert deadline is not None
        base = min(FIRST_DELAY * 2**attempt, LONGEST_DELAY)
        assert 0.499 * base <= deadline - now <= 1.501 * base
        assert not dialler.take(deadline - 1e-6)
        assert dialler.take(deadline)
        now = deadline


@given(st.floats(0.0, 1.0, exclude_max=True), st.floats(0.3, 20.0))
def test_pages_of_an_absent_robot_keep_to_their_share_until_it_knocks(draw: float, page: float) -> None:
    dialler, now, spent = Dialler(lambda: draw), 0.0, 0.0
    while spent < 10 * EAGER_S:
        deadline = dialler.next_deadline()
        assert deadline is not None
        began = max(now, deadline)
        if spent >= EAGER_S:
            assert page <= SHARE * (began - now + page) * 1.000001
        assert dialler.take(began)
        now = began + page
        spent += page
        dialler.ended(now, page)
    dialler.hurry(now)
    assert dialler.take(now + FIRST_DELAY)


def test_calls_that_fail_at_once_make_no_neighbour_an_absent_one() -> None:
    """The own adapter is off for a while, and the first call after it meets a neighbour that is still busy."""
    dialler, now = Dialler(lambda: 0.5), 0.0
    for page in (0.001,) * 20 + (5.12, 5.12):
        deadline = dialler.next_deadline()
        assert deadline is not None
        now = max(now, deadline)
        assert dialler.take(now)
        now += page
        dialler.ended(now, page)
    deadline = dialler.next_deadline()
    assert deadline is not None
    assert deadline - now <= LONGEST_DELAY


def test_only_a_link_that_lasted_resets_the_back_off() -> None:
    dialler = Dialler(lambda: 0.5)
    for start in (0.0, 10.0, 20.0):
        dialler.take(start)
        dialler.up(start)
        dialler.ended(start + 0.5)
    assert dialler.next_deadline() == pytest.approx(20.5 + 4 * FIRST_DELAY)
    dialler.take(30.0)
    dialler.up(30.0)
    dialler.ended(31.5)
    assert dialler.next_deadline() == pytest.approx(31.5 + FIRST_DELAY)
