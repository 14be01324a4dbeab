"""The figures of the thesis from its own recordings, and what our models make of the same."""

import math
import random

import pytest
from conftest import thinned
from thesis_data import DATA, calibration_samples, needs_calibration, needs_localization

from services.dwm.core.calibration.fitting import (
    error_of,
    fit_curved,
    fit_linear,
    fit_logarithmic,
    fit_places,
    fit_ranges,
    robot_offset,
)
from services.dwm.core.calibration.models import RangeModel
from services.dwm.core.calibration.samples import TARGET, TARGET_PLACE, SampleGroup, groups, of_recording, spots
from services.dwm.core.estimation import thesis
from services.dwm.core.estimation.filters import mean
from services.dwm.core.estimation.multilateration import Fix, multilaterate
from swarm.recording.thesis_ranges import read_folder

MODULES = {TARGET: (*TARGET_PLACE, 0.0)}
THESIS = RangeModel(0.946976, -0.05964849)
AGENTS = [(0.5, 1.5), (1.0, 0.5), (1.5, 1.5)]
TRUE = [math.dist(place, TARGET_PLACE) for place in AGENTS]


@pytest.fixture(scope="module")
def samples():
    return calibration_samples()


@needs_calibration
def test_equations_2_4_and_2_8_and_table_2_3(samples):
    found = thesis.distances(samples)
    assert (found.samples, found.outliers) == (852, 12)
    assert (f"{found.gain:.3f}", f"{found.offset:.3f}") == ("1.056", "6.299")
    assert 1 / found.gain == pytest.approx(0.946976, abs=5e-7)
    assert -found.offset / found.gain == pytest.approx(-5.964849, abs=5e-7)
    assert [f"{-value:.2f}" if value < 0 else f"{value:.2f}" for value in found.uncalibrated] == ["11.51", "3.02"]
    assert (f"{found.calibrated[0]:.3f}", f"{found.calibrated[1]:.2f}") == ("0.072", "2.12")


@needs_calibration
def test_figure_2_11_is_not_what_the_thesis_says_of_it(samples):
    found = thesis.distances(samples)
    assert found.raw_90 == pytest.approx(18.1, abs=0.05)  # the text says 19
    assert found.processed_90 == pytest.approx(5.05, abs=0.005)  # the text says 4,
    assert found.processed_80 == pytest.approx(4.03, abs=0.005)  # which are 80 %


@needs_calibration
def test_equation_2_10_and_table_2_4(samples):
    found = thesis.positions(samples)
    (a, b), (c, d) = found.model.matrix
    assert (a, b, c, d) == pytest.approx((0.93538932, 0.00353817, -0.01071457, 0.94470965), abs=5e-9)
    assert found.model.offset == pytest.approx((4.6239576, 5.0861534), abs=5e-8)
    assert [f"{value:.2f}" for value in found.uncalibrated] == ["1.31", "5.17"]
    assert [f"{abs(value):.2f}" for value in found.calibrated] == ["0.00", "3.51"]
    assert (found.uncalibrated_2d, found.calibrated_2d) == pytest.approx((7.54, 4.96), abs=0.005)


@needs_calibration
def test_errors_of_places_are_those_of_figure_2_14(samples):
    found = thesis.positions(samples)
    assert found.raw_90 == pytest.approx(14.7, abs=0.05)  # the text says 15
    assert found.processed_90 == pytest.approx(8.88, abs=0.005)  # the text says 8


@needs_calibration
def test_ranges_at_places_left_out(samples):
    fit = fit_ranges(groups(samples, MODULES))
    assert fit.name == "curved"
    assert fit.left_out["raw"] == pytest.approx(0.1142, abs=5e-5)
    assert fit.left_out["linear"] == pytest.approx(0.0290, abs=5e-5)
    assert fit.left_out["curved"] < 0.0273
    assert fit.nested <= 0.0275  # the choice made anew without each place


def parts(group, number, of):
    """The `number`-th of so many parts of a group in the order of time: about an orientation each."""
    size = len(group.values)
    return group.values[number * size // of : (number + 1) * size // of]


def errors_at(left, model):
    return math.sqrt(mean([error_of(model, g, g.raw_mean) ** 2 for g in left]))


@needs_calibration
@pytest.mark.parametrize("unseen", range(4))
def test_never_worse_than_linear_on_orientations_left_out(samples, unseen):
    every = groups(samples, MODULES)
    seen = [
        SampleGroup(g.place, g.true, None, tuple(v for part in range(4) if part != unseen for v in parts(g, part, 4)))
        for g in every
    ]
    left = [SampleGroup(g.place, g.true, None, parts(g, unseen, 4)) for g in every]
    chosen = fit_ranges(seen)
    assert chosen.name == "curved"
    assert errors_at(left, chosen.model) < errors_at(left, fit_linear(seen))


@needs_calibration
@pytest.mark.parametrize(
    "unseen",
    [lambda g: g.true > 1.2, lambda g: g.true < 0.3, lambda g: g.true < 0.6],
    ids=["far", "near", "nearer"],
)
def test_never_worse_than_linear_at_distances_left_out(samples, unseen):
    every = groups(samples, MODULES)
    seen, left = [g for g in every if not unseen(g)], [g for g in every if unseen(g)]
    assert errors_at(left, fit_ranges(seen).model) <= errors_at(left, fit_linear(seen))


@needs_calibration
def test_hardly_ever_worse_than_linear_with_half_of_the_places(samples):
    """No model can be promised never to be worse at places it has not seen; the curved one is in 1 half of 20."""
    every = groups(samples, MODULES)
    generator = random.Random(1)
    squares, worse = [0.0, 0.0], 0
    for _ in range(300):
        left = set(generator.sample(range(22), 11))
        seen, unseen = [g for g in every if g.place not in left], [g for g in every if g.place in left]
        rms = [errors_at(unseen, fit(seen)) for fit in (fit_curved, fit_linear)]
        squares = [total + value**2 for total, value in zip(squares, rms, strict=True)]
        worse += rms[0] > rms[1]
    assert worse <= 0.08 * 300
    assert squares[0] < 0.9 * squares[1]


@needs_calibration
@needs_localization
@pytest.mark.parametrize("run", thinned(["test_2", "test_3", "test_5"]))
def test_never_worse_than_linear_on_other_recordings(samples, run):
    fit = groups(samples, MODULES)
    errors = {"chosen": [], "linear": []}
    for recording, true in zip(read_folder(DATA / "localization" / run), TRUE, strict=True):
        measured = mean([row.distance for row in recording.rows])
        if run != "test_2":  # these were recorded calibrated by eq. 2.8
            measured = (measured - THESIS.offset) / THESIS.gain
        errors["chosen"].append(fit_ranges(fit).model.distance(measured) - true)
        errors["linear"].append(fit_linear(fit).distance(measured) - true)
    rms = {name: math.sqrt(mean([error**2 for error in of])) for name, of in errors.items()}
    assert rms["chosen"] < rms["linear"]


@needs_calibration
def test_the_error_at_places_left_out_chooses_the_model(samples):
    fit = fit_places(spots(samples))
    assert fit.left_out["raw"] == pytest.approx(0.0742, abs=5e-5)
    assert fit.left_out["affine"] == pytest.approx(0.0539, abs=5e-5)
    assert fit.name == "scaled"
    assert fit.nested < 0.0510


@needs_localization
def test_a_robots_offset_learned_in_one_run_holds_in_others():
    """Each robot stood at one place in all runs: its offset and that place's are one number here."""
    offsets = []
    for index, recording in enumerate(read_folder(DATA / "localization" / "test_2")):
        offsets.append(robot_offset(THESIS, groups(of_recording(recording, AGENTS[index]), MODULES)))
    assert offsets == pytest.approx([0.0327, -0.0049, -0.0071], abs=3e-3)
    for run, before, after in (("test_3", 0.031, 0.013), ("test_5", 0.0222, 0.009)):
        recordings = read_folder(DATA / "localization" / run)
        rows = list(zip(*(recording.rows for recording in recordings), strict=False))
        assert target_error(rows, [0.0] * 3) == pytest.approx(before, abs=5e-4)
        assert target_error(rows, offsets) <= after


def target_error(rows, offsets):
    """Distance of the mean least-squares target from the true one, m."""
    found = []
    for row in rows[::5]:
        places = [(item.x, item.y, 0.0) for item in row]
        fix = multilaterate(places, [item.distance - o for item, o in zip(row, offsets, strict=True)], 0.0, 1.0)
        assert isinstance(fix, Fix)
        found.append((fix.x, fix.y))
    return math.dist((mean([x for x, _ in found]), mean([y for _, y in found])), TARGET_PLACE)


def test_logarithmic_model_is_the_tangent_below_what_it_was_fitted_to():
    fit = fit_logarithmic(
        [SampleGroup(k, d, None, (d + 0.1 + 0.05 * math.log(d),)) for k, d in enumerate((0.3, 0.6, 1.2))]
    )
    assert fit.log < 0
    low, step = fit.low, 1e-6
    slope = (fit.distance(low + step) - fit.distance(low)) / step
    assert (fit.distance(low) - fit.distance(low - step)) / step == pytest.approx(slope, rel=1e-3)
    assert fit.distance(low / 2) == pytest.approx(fit.distance(low) - slope * low / 2, rel=1e-3)
    assert fit.distance(0.0) >= 0.0
