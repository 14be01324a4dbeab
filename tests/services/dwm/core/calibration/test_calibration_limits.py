"""What a calibration refuses: whatever samples say, a model that is written is one that a module can have."""

import contextlib
import math
import random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from services.dwm.core.calibration import calibration_file, limits
from services.dwm.core.calibration.calibration_file import CalibrationFile, Evidence
from services.dwm.core.calibration.fitting import fit_places, fit_ranges, place_error
from services.dwm.core.calibration.models import position
from services.dwm.core.calibration.samples import SampleGroup, Spot
from swarm.errors import LocalError

LENGTH = st.floats(0.0, 5.0)
DISTANCES = (0.3, 0.6, 0.9, 1.2, 1.5, 1.8)
PLACES = [(0.5 * i, 0.6 * j) for i in range(3) for j in range(3)]


def ranges(report, distances=DISTANCES):
    return [SampleGroup(k, d, None, (max(0.0, report(d)),) * 5) for k, d in enumerate(distances)]


def spots(report, places=PLACES):
    return [Spot(k, x, y, (report(x, y),) * 5) for k, (x, y) in enumerate(places)]


def written(**parts):
    """What a service would read of such a file."""
    evidence = Evidence("m", "2026-01-01T00:00:00+00:00", 1, 1, "0", {}, 0.0, ())
    file = CalibrationFile("r0", "x", (), **{name: (model, evidence) for name, model in parts.items()})
    return calibration_file.parse(calibration_file.text_of(file), "f")


@given(st.lists(st.tuples(LENGTH, st.floats(-0.3, 0.3)), min_size=1, max_size=8), st.floats(-1.5, 1.5))
def test_any_ranges_give_a_model_that_is_read_again_and_rises_with_the_range_or_are_refused(pairs, scale):
    groups = [SampleGroup(k, d, None, (max(0.0, scale * d + off),) * 3) for k, (d, off) in enumerate(pairs)]
    with contextlib.suppress(LocalError):
        model = fit_ranges(groups).model
        assert written(distance=model).distance[0] == model
        low, high = min(g.mean for g in groups), max(g.mean for g in groups)
        steps = [low + (high - low) * i / 10 for i in range(11)]
        found = [model.distance(at) for at in steps]
        assert found == sorted(found)
        assert all(abs(to - at) <= limits.LONGEST_BIAS + 1e-9 for at, to in zip(steps, found, strict=True))


@given(st.lists(st.tuples(LENGTH, LENGTH, st.floats(-0.3, 0.3)), min_size=1, max_size=8), st.floats(-1.5, 1.5))
def test_any_places_give_a_model_that_keeps_places_apart_or_are_refused(rows, scale):
    found = [Spot(k, x, y, ((scale * x + off, y - off),) * 3) for k, (x, y, off) in enumerate(rows)]
    with contextlib.suppress(LocalError):
        model = fit_places(found).model
        assert written(position=model).position[0] == model
        origin = position(model, 0.0, 0.0)
        for i in range(12):
            moved = math.dist(position(model, math.cos(i), math.sin(i)), origin)
            assert limits.SCALES[0] - 1e-9 <= moved <= limits.SCALES[1] + 1e-9


@settings(max_examples=12)
@given(st.floats(0.85, 1.2), st.floats(-0.1, 0.3), st.integers(0, 100))
def test_a_module_as_they_are_is_accepted(scale, offset, seed):
    noise = random.Random(seed)
    groups = ranges(lambda d: d * scale + offset + noise.gauss(0, 0.01), (0.5, 0.8, 1.1, 1.4, 1.7, 2.0))
    model = fit_ranges(groups).model
    assert model.distance(1.2 * scale + offset) == pytest.approx(1.2, abs=0.05)
    turned = math.radians(10)
    report = spots(lambda x, y: (scale * (x * math.cos(turned) - y * math.sin(turned)) + offset,
                                 scale * (x * math.sin(turned) + y * math.cos(turned))))  # fmt: skip
    model = fit_places(report).model
    assert all(place_error(model, spot, spot.mean) < 1e-6 for spot in report)


@given(st.floats(0, math.pi), st.floats(-2, 2), st.floats(-2, 2))
def test_places_on_one_line_are_refused_wherever_it_lies(angle, x, y):
    line = [(x + 0.4 * k * math.cos(angle), y + 0.4 * k * math.sin(angle)) for k in range(6)]
    with pytest.raises(LocalError, match=r"within 0 cm of one line, .* beside that line"):
        fit_places(spots(lambda x, y: (1.05 * x, 1.05 * y), line))


@pytest.mark.parametrize(
    ("report", "words"),
    [
        (lambda d: 3.0 - d, "slope .* is -1.00"),
        (lambda d: 0.5 * d + 0.3, "slope .* is 2.00, not 0.6 to 1.6"),
        (lambda d: 1.0, "not determine"),
        (lambda d: d + 1.5, r"changes a range of 1\.80 m by -1\.50 m"),
        (lambda d: d + (0.4 if d == 0.9 else 0.0), r"more than 10 cm .* the worst is place 3, 0\.90 m from its module"),
    ],
)
def test_ranges_of_no_module_are_refused_with_the_reason(report, words):
    with pytest.raises(LocalError, match=words):
        fit_ranges(ranges(report))


@pytest.mark.parametrize(
    ("report", "words"),
    [
        (lambda x, y: (y, x), "mirrors places: are x and y .* exchanged"),
        (lambda x, y: (-x, -y), "turns places by .*180 degrees"),
        (lambda x, y: (0.5 * x, y), "scales are 1.00 and 2.00, not 0.6 to 1.6"),
        (lambda x, y: (x, y + 1.2 * (x == 0.5 and y == 0.6)), r"the worst is place 5 at \(0\.50, 0\.60\)"),
    ],
)
def test_places_of_no_module_are_refused_with_the_reason(report, words):
    with pytest.raises(LocalError, match=words):
        fit_places(spots(report))


def test_too_few_places_and_an_offset_of_no_module_are_refused():
    with pytest.raises(LocalError, match="positions at 3 of at least 4 places: measure at 1 more"):
        fit_places(spots(lambda x, y: (x, y), PLACES[:3]))
    limits.check_offset(-0.3)
    with pytest.raises(LocalError, match=r"ranges \+0\.60 m too long .* stand at this --place"):
        limits.check_offset(0.6)
