import contextlib
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.dwm.core.calibration import samples
from services.dwm.core.calibration.samples import (
    HEADER,
    TARGET,
    RangeSample,
    SampleGroup,
    Spot,
    digest,
    groups,
    read,
    spots,
)
from swarm.errors import RecordingError

NUMBER = st.floats(-100, 100)
ROW = st.builds(
    RangeSample,
    st.integers(0, 99),
    NUMBER,
    NUMBER,
    st.none() | NUMBER,
    NUMBER,
    st.sampled_from(["C933", "D001"]),
    st.floats(0, 100),
    NUMBER,
    NUMBER,
)


@given(st.lists(ROW, min_size=1, max_size=20))
def test_what_is_written_is_read_again(rows):
    text = "\n".join([HEADER, *map(samples.write, rows)])
    assert read(text, "f") == rows
    assert digest(read(text, "f")) == digest(rows)


def test_a_report_without_a_fix_has_ranges_alone():
    row = RangeSample(0, 1.0, 2.0, None, 3.0, "C933", 1.5, None, None)
    assert read(f"{HEADER}\n{samples.write(row)}\n", "f") == [row]
    assert spots([row]) == []


def test_the_layout_of_the_thesis():
    found = read("0\n268.0,228.0,1083.0\n5\n1400,1700,1010\n", "f", samples.THESIS_PLACES)
    assert found[0] == RangeSample(0, 0.25, 1.0, None, 2.0, TARGET, 0.268, 0.228, 1.083)
    assert found[1] == RangeSample(5, 1.75, 1.0, None, 4.0, TARGET, 1.4, 1.7, 1.01)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "f: holds no samples"),
        (HEADER, "f: holds no samples"),
        ("268.0,228.0,1083.0", "f:1: a sample before the first place"),
        ("22\n1,2,3", "f:1: place 22, and there are places 0 to 21"),
        ("1.5\n1,2,3", "f:1: place 1.5"),
        ("0\n1,2", "f:2: 2 columns: neither ours"),
        ("0\n1,x,3", "f:2: 'x' is no number"),
        ("0\n1,1_0,3", "f:2: '1_0' is no number"),
        ("0\n-1,2,3", "f:2: a range of -1 mm"),
        (f"{HEADER}\n0,1,1,,0,C933,1", "f:2: 7 columns, expected 9"),
        (f"{HEADER}\n0,1,1,,0,C933,nan,,", "f:2: 'nan' is no number"),
        (f"{HEADER}\n0,1,1,,0,C933,-1,,", "f:2: a range of -1 m"),
        (f"{HEADER}\n0,1,1,,0,C933,1,2,", "f:2: px without py"),
        (f"{HEADER}\nx,1,1,,0,C933,1,2,3", "f:2: the place 'x' is no number from 0"),
    ],
)
def test_what_is_wrong_is_named_by_line(text, words):
    with pytest.raises(RecordingError) as caught:
        read(text, "f", samples.THESIS_PLACES)
    assert str(caught.value).startswith(words)


@given(st.text(max_size=200))
def test_any_text_is_read_or_refused(text):
    with contextlib.suppress(RecordingError):
        read(text, "f", [(0.0, 0.0)])


def test_a_file_in_the_thesis_layout_is_no_better_than_the_places_that_are_told_for_it():
    with pytest.raises(RecordingError, match=r"f:1: in the thesis' layout, .*--places .x,y .*--places thesis"):
        read("0\n268.0,228.0,1083.0\n", "f")
    (found,) = read("0\n268.0,228.0,1083.0\n", "f", [(1.5, 0.5)], "D00A")
    assert (found.x, found.y, found.module) == (1.5, 0.5, "D00A")


def test_groups_are_by_place_module_and_orientation():
    rows = [
        RangeSample(0, 3.0, 4.0, 0.0, 0.0, "C933", 5.1, 3.0, 4.0),
        RangeSample(0, 3.0, 4.0, 0.0, 0.0, "D001", 1.0, 3.0, 4.0),
        RangeSample(0, 3.0, 4.0, 0.0, 0.1, "C933", 5.3, 3.2, 4.0),
        RangeSample(0, 3.0, 4.0, 1.5, 0.2, "C933", 5.5, None, None),
        RangeSample(1, 0.0, 1.0, 0.0, 0.3, "FFFF", 5.5, 0.0, 1.0),
    ]
    assert groups(rows, {"C933": (0.0, 0.0, 0.0), "D001": (3.0, 4.0, 2.0)}) == [
        SampleGroup(0, 5.0, 0.0, (5.1, 5.3)),
        SampleGroup(0, 2.0, 0.0, (1.0,)),
        SampleGroup(0, 5.0, 1.5, (5.5,)),
    ]
    assert spots(rows) == [Spot(0, 3.0, 4.0, ((3.0, 4.0), (3.2, 4.0))), Spot(1, 0.0, 1.0, ((0.0, 1.0),))]


def test_means_are_of_what_is_no_outlier():
    group = SampleGroup(0, 1.0, None, (1.0, 1.1, 1.2, 1.1, 9.0))
    assert group.mean == pytest.approx(1.1)
    assert group.raw_mean == pytest.approx(2.68)
    spot = Spot(0, 0.0, 0.0, ((0.0, 1.0), (1.0, 0.0), (0.0, -1.0), (-1.0, 0.0), (0.0, 0.0), (30.0, 0.0)))
    assert math.hypot(*spot.mean) < 1e-9
    assert spot.raw_mean == pytest.approx((5.0, 0.0))
