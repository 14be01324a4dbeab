import contextlib
import re
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.dwm.core.calibration.calibration_file import (
    CalibrationFile,
    Evidence,
    check,
    described,
    layout_of,
    parse,
    text_of,
)
from services.dwm.core.calibration.models import Calibration, RangeModel
from swarm.config.types import Affine, Anchor
from swarm.errors import ConfigError

ANCHORS = (Anchor("D001", 0.0, 0.0), Anchor("D002", 1.94, 0.0, 0.3))
EVIDENCE = Evidence(
    "linear", "2026-11-21T06:00:00+00:00", 22, 852, "ab" * 32, {"raw": 0.114, "linear": 0.029}, 0.029, ((0.5, 0.01),)
)
MODEL = RangeModel(0.95, -0.06, -0.03, 0.28, 0.033, (0.01, -0.02))
FILE = CalibrationFile(
    "r0",
    layout_of(ANCHORS),
    described(ANCHORS),
    (MODEL, EVIDENCE),
    (Affine(((0.9, 0.0), (0.1, 1.0)), (0.04, 0.05)), replace(EVIDENCE, residuals=((0.5, 0.5, 0.02),))),
)

FLOAT = st.floats(-1e6, 1e6)
POSITIVE = st.floats(1e-3, 1e3)
EVIDENCES = st.builds(
    Evidence,
    st.sampled_from(["linear", "curved + heading"]),
    st.just("2026-11-21T06:00:00+00:00"),
    st.integers(0, 99),
    st.integers(0, 9999),
    st.just("00" * 32),
    st.dictionaries(st.sampled_from(["raw", "linear", "curved + heading"]), FLOAT),
    FLOAT,
    st.lists(st.tuples(FLOAT, FLOAT), max_size=3).map(tuple),
)


@given(st.builds(RangeModel, POSITIVE, FLOAT, FLOAT, POSITIVE, FLOAT, st.tuples(FLOAT, FLOAT)), EVIDENCES)
def test_a_calibration_file_is_read_as_it_was_written(model, evidence):
    file = CalibrationFile("r0", "00", ("D001 (0, 0, 0)",), (model, evidence))
    assert parse(text_of(file), "f") == file


def test_a_calibration_file_holds_ranges_places_or_both():
    assert parse(text_of(FILE), "f") == FILE
    ranges = CalibrationFile("r0", FILE.layout, FILE.anchors, FILE.distance)
    places = CalibrationFile("r0", FILE.layout, FILE.anchors, None, FILE.position)
    assert ranges.with_parts(places) == FILE
    assert parse(text_of(places), "f").over(Calibration(RangeModel(2.0))).ranges == RangeModel(2.0)
    assert parse(text_of(ranges), "f").over(Calibration()) == Calibration(MODEL, Affine())


def test_a_layout_is_addresses_and_places_whatever_their_order():
    assert layout_of(ANCHORS) == layout_of(tuple(reversed(ANCHORS)))
    assert layout_of(ANCHORS) == layout_of((ANCHORS[0], Anchor("D002", 1.9401, 0.0, 0.3)))
    for moved in (Anchor("D002", 1.95, 0.0, 0.3), Anchor("D003", 1.94, 0.0, 0.3), Anchor("D002", 1.94, 0.0, 0.31)):
        assert layout_of((ANCHORS[0], moved)) != layout_of(ANCHORS)


def test_another_layout_and_another_robot_are_refused():
    check(FILE, "f", "r0", ANCHORS)
    with pytest.raises(ConfigError, match=r"f: is the calibration of r0, this is r1"):
        check(FILE, "f", "r1", ANCHORS)
    moved = (ANCHORS[0], Anchor("D002", 1.97, 0.0, 0.3))
    words = (
        "f: was made with other anchors (D001 (0, 0, 0), D002 (1.94, 0, 0.3); now: D001 (0, 0, 0), D002 (1.97, 0, 0.3))"
    )
    with pytest.raises(ConfigError, match=re.escape(words)):
        check(FILE, "f", "r0", moved)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("robot =", "robt =", "f: robt: unknown entry; did you mean robot?"),
        ("gain = 0.95", "gain = 0", "f: [distance] gain: expected a number above 0, got 0"),
        ("low = 0.28", "low = 0", "f: [distance] low: expected a number above 0, as log is not 0"),
        ("antenna = [0.01, -0.02]", "antenna = [1]", "f: [distance] antenna: expected two numbers"),
        ("matrix = [[0.9, 0.0], [0.1, 1.0]]", "matrix = [[0.9, 0.0]]", "f: [position] matrix: expected two rows"),
        ("residuals = [[0.5, 0.01]]", "residuals = [[0.5]]", "f: [distance] residuals: expected a list of lists of 2"),
        ("made = 2026-11-21T06:00:00+00:00", 'made = "now"', "f: [distance] made: expected a date and time"),
        ('left_out = { "raw" = 0.114', 'left_out = { "raw" = "x"', "f: [distance] left_out: expected numbers"),
        ("anchors = [", "anchors = [1, ", "f: anchors: expected a list of texts"),
        ("[distance]", "[distance", "f: not valid TOML"),
    ],
)
def test_what_is_wrong_is_named(old, new, words):
    text = text_of(FILE)
    assert old in text
    with pytest.raises(ConfigError) as caught:
        parse(text.replace(old, new, 1), "f")
    assert str(caught.value).startswith(words)


@given(st.text(max_size=100) | st.tuples(st.integers(0, 900), st.integers(0, 30), st.text(max_size=10)))
def test_any_text_is_a_calibration_or_refused(change):
    text = text_of(FILE)
    if isinstance(change, str):
        text = change
    else:
        at, length, new = change
        text = text[:at] + new + text[at + length :]
    with contextlib.suppress(ConfigError):
        assert isinstance(parse(text, "f"), CalibrationFile)
