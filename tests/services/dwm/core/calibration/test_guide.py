import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.dwm.calibrate.session import Presses, Reports
from services.dwm.core.calibration.guide import QUARTERS, SETTLE, Guide, GuideButton, grid
from swarm.messages import Buttons, Pose, Range, Ranges

PLACES = [(0.5, 0.5), (1.0, 0.5), (1.0, 1.0)]


def measure(guide, count, distance=1.0):
    for _ in range(SETTLE if not guide.done and guide.measuring and guide.progress("").startswith("0/") else 0):
        assert guide.report(0.0, [("C933", 9.0)], None) == []
    for i in range(count):
        guide.report(float(i), [("C933", distance + 0.01 * (i % 2))], (0.4, 0.5))


def test_leads_through_places_and_orientations():
    guide = Guide(PLACES, QUARTERS, 2)
    prompts = []
    while not guide.done:
        prompts.append(guide.prompt())
        guide.press(GuideButton.START)
        measure(guide, 2)
        assert not guide.measuring
    assert len(prompts) == 12
    assert prompts[0] == "place 1 of 3: (0.50, 0.50) m, heading 0 degrees"
    assert prompts[5] == "place 2 of 3: (1.00, 0.50) m, heading 90 degrees"
    assert len(guide.samples) == 24
    assert guide.samples[10].heading == pytest.approx(math.pi / 2)
    assert (guide.samples[10].place, guide.samples[10].x, guide.samples[10].px) == (1, 1.0, 0.4)
    assert guide.prompt() == "done"


def test_nothing_is_taken_before_the_start():
    guide = Guide(PLACES)
    measure(guide, 5)
    assert guide.samples == []
    guide.press(GuideButton.START)
    guide.press(GuideButton.START)  # at once: not meant
    measure(guide, 5)
    assert guide.samples == []


def test_start_again_ends_an_orientation_before_it_is_enough():
    guide = Guide(PLACES, QUARTERS, 10)
    guide.press(GuideButton.START)
    measure(guide, 4)
    guide.press(GuideButton.START)
    assert "heading 90" in guide.prompt()
    assert len(guide.samples) == 4


def test_next_leaves_the_rest_of_a_place_out():
    guide = Guide(PLACES)
    guide.press(GuideButton.NEXT)
    assert guide.prompt().startswith("place 2 of 3")
    guide.press(GuideButton.NEXT)
    guide.press(GuideButton.NEXT)
    assert guide.done
    guide.press(GuideButton.START)  # without effect
    assert guide.done


def test_redo_forgets_this_place_or_the_one_before():
    guide = Guide(PLACES, QUARTERS[:1], 2)
    guide.press(GuideButton.START)
    measure(guide, 2)
    guide.press(GuideButton.START)
    measure(guide, 1)
    guide.press(GuideButton.REDO)
    assert guide.prompt().startswith("place 2")
    assert [sample.place for sample in guide.samples] == [0, 0]
    guide.press(GuideButton.REDO)
    assert guide.prompt().startswith("place 1")
    assert guide.samples == []


def test_quit_keeps_what_there_is():
    guide = Guide(PLACES, QUARTERS[:1], 2)
    guide.press(GuideButton.START)
    measure(guide, 1)
    guide.press(GuideButton.QUIT)
    assert guide.done
    assert len(guide.samples) == 1


def test_progress_shows_the_spread():
    guide = Guide(PLACES, QUARTERS, 10)
    guide.press(GuideButton.START)
    assert guide.progress("C933") == "0/10"
    measure(guide, 6)
    assert guide.progress("C933") == "6/10  C933 1.005 m +- 0.5 cm, 0 outliers"
    assert guide.progress("D001") == "6/10"


@given(st.lists(st.sampled_from([*GuideButton, None]), max_size=60))
def test_whatever_is_pressed_the_samples_are_where_the_robot_was_asked_to_be(presses):
    guide = Guide(PLACES, QUARTERS[:2], 3)
    for press in presses:
        if press is None:
            guide.report(0.0, [("C933", 1.0)], None)
        else:
            guide.press(press)
    assert all((s.x, s.y) == PLACES[s.place] for s in guide.samples)
    if not guide.done:
        assert guide.stop.place in range(3)


def test_a_grid_goes_row_by_row_and_back():
    assert grid([(0.0, 0.0), (2.0, 0.0), (1.0, 1.0)], 1.0) == [(0.5, 0.5), (1.5, 0.5)]
    assert grid([(0.0, 0.0), (2.0, 2.0)], 1.0) == [(0.5, 0.5), (1.5, 0.5), (1.5, 1.5), (0.5, 1.5)]
    assert grid([(0.0, 0.0), (0.1, 0.1)], 1.0) == [(0.05, 0.05)]


def item(anchor, raw, sequence, stale=False):
    return Range(anchor, raw, raw, 100, 0.0, sequence, stale)


def test_reports_are_ranges_and_pose_without_what_was_there_before():
    reports = Reports()
    pose = Pose(1.0, 7, 0.0, 0.0, None, 90, "average", raw_x=0.5, raw_y=0.6)
    assert reports.take(Ranges(1.0, 7, (item("A001", 1.0, 3), item("A002", 2.0, 9, True)))) is None
    assert reports.take(pose) == (1.0, [("A001", 1.0)], (0.5, 0.6))
    assert reports.take(pose) is None  # its ranges were lost
    reports.take(Ranges(1.1, 8, (item("A001", 1.1, 4), item("A003", 2.0, 1))))
    assert reports.take(pose) is None  # of another report
    reports.take(Ranges(1.2, 9, (item("A001", 1.1, 4), item("A003", 2.5, 2))))
    later = Pose(1.2, 9, 0.0, 0.0, None, 0, "average")
    assert reports.take(later) == (1.2, [("A001", 1.1), ("A003", 2.5)], None)


def test_presses_count_from_the_first_message_and_none_is_lost():
    presses = Presses()
    assert presses.take(Buttons(0.0, False, False, False, 5, 1, 0)) == []
    assert presses.take(Buttons(1.0, True, False, False, 6, 1, 0)) == [GuideButton.START]
    assert presses.take(Buttons(2.0, False, False, False, 6, 3, 1)) == [
        GuideButton.NEXT,
        GuideButton.NEXT,
        GuideButton.REDO,
    ]
    assert presses.take(Buttons(3.0, False, False, False, 0, 0, 0)) == []  # the balancer began anew
    assert presses.take(Buttons(4.0, False, False, False, 1, 0, 0)) == [GuideButton.START]
