import math
import random
from itertools import product

import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.dwm.core.calibration.fitting import (
    fit_affine,
    fit_linear,
    fit_logarithmic,
    fit_places,
    fit_ranges,
    fit_scaled,
    fit_stretched,
    robot_offset,
    with_antenna,
)
from services.dwm.core.calibration.models import RangeModel, position
from services.dwm.core.calibration.samples import SampleGroup, Spot
from swarm.config.types import Linear
from swarm.errors import LocalError

DISTANCES = [0.25, 0.5, 0.75, 1.0, 1.25, 1.5, 0.7, 1.1, 0.9, 1.45]


def world(report, distances=DISTANCES, headings=(None,), noise=0.0, samples=10, seed=1):
    generator = random.Random(seed)
    return [
        SampleGroup(k, d, h, tuple(report(d, h) + generator.gauss(0, noise) for _ in range(samples)))
        for k, d in enumerate(distances)
        for h in headings
    ]


@given(st.floats(0.8, 1.2), st.floats(-0.2, 0.2))
def test_a_linear_module_is_undone(slope, bias):
    model = fit_linear(world(lambda d, _: slope * d + bias + 0.3))
    for distance in DISTANCES:
        assert model.distance(slope * distance + bias + 0.3) == pytest.approx(distance, abs=1e-9)


def test_the_thesis_model_by_its_name():
    model = RangeModel.of(Linear(0.946976, -0.05964849))
    assert model.distance(0.624) == pytest.approx(0.624 * 0.946976 - 0.05964849)
    assert model.distance(0.02) == 0.0


def test_a_linear_world_keeps_the_linear_model():
    fit = fit_ranges(world(lambda d, _: 1.056 * d + 0.063, noise=0.04))
    assert fit.name == "linear"
    assert fit.left_out["linear"] < 0.03 < fit.left_out["raw"]
    assert len(fit.residuals) == len(DISTANCES)


def test_a_world_whose_bias_grows_with_the_logarithm_gets_the_curved_one():
    fit = fit_ranges(world(lambda d, _: d + 0.12 + 0.06 * math.log(d), noise=0.01))
    assert fit.name == "curved"
    assert fit.left_out["curved"] < 0.9 * fit.left_out["linear"]


def test_few_distances_are_no_ground_for_a_curve():
    fit = fit_ranges(world(lambda d, _: d + 0.12 + 0.06 * math.log(d), [0.3, 0.6, 1.2, 0.3, 0.6, 1.2]))
    assert fit.name == "linear"
    assert "curved" not in fit.left_out


def test_an_antenna_is_found_where_the_orientation_was_told():
    headings = [k * math.pi / 2 for k in range(4)]
    groups = world(lambda d, h: 1.05 * d + 0.06 + 0.03 * math.cos(h - 0.5), headings=headings, noise=0.01)
    fit = fit_ranges(groups)
    assert fit.name.endswith("+ heading")
    assert fit.model.antenna == pytest.approx((0.03 * math.cos(0.5), 0.03 * math.sin(0.5)), abs=0.003)
    calm = fit_ranges(world(lambda d, h: 1.05 * d + 0.06, headings=headings, noise=0.04))
    assert not calm.name.endswith("+ heading")


def test_a_places_own_error_is_none_of_the_antenna():
    groups = []
    for k, d in enumerate(DISTANCES):  # each place has an error, and was looked at in some orientations only
        for h in (0.0, 2.0, 4.0)[: 2 + k % 2]:
            groups.append(SampleGroup(k, d, h, (d + 0.05 * (-1) ** k + 0.02 * math.cos(h),)))
    assert with_antenna(fit_linear)(groups).antenna == pytest.approx((0.02, 0.0), abs=2e-3)


def test_a_robots_offset_counts_each_place_once():
    model = RangeModel(1.0, 0.0)
    groups = [SampleGroup(0, 1.0, h, (1.05,)) for h in (0.0, 1.0, 2.0)] + [SampleGroup(1, 2.0, None, (2.01,))]
    assert robot_offset(model, groups) == pytest.approx(0.03)
    assert RangeModel(1.0, 0.0, robot=0.03).distance(1.05) == pytest.approx(1.02)


@pytest.mark.parametrize(
    ("distances", "words"),
    [
        ([0.5, 1.0], "at 2 of at least 3 places: measure at 1 more"),
        ([1.0, 1.0, 1.2, 1.0], r"between 1\.00 and 1\.20 m: .* nearer to the module or farther"),
    ],
)
def test_too_little_is_said(distances, words):
    with pytest.raises(LocalError, match=words):
        fit_ranges(world(lambda d, _: d, distances))


def test_logarithmic_model_undoes_its_own_world():
    model = fit_logarithmic(world(lambda m, _: m, DISTANCES))
    assert (model.offset, model.log) == pytest.approx((0.0, 0.0), abs=1e-9)


def spots(report, noise=0.0, seed=1):
    generator = random.Random(seed)
    places = [(0.5 * i, 0.5 * j) for i, j in product(range(4), range(4))]
    return [
        Spot(k, x, y, tuple((u + generator.gauss(0, noise), v + generator.gauss(0, noise))
                            for u, v in [report(x, y)] * 8))
        for k, (x, y) in enumerate(places)
    ]  # fmt: skip


def test_models_of_places_undo_their_worlds():
    for fit, report in (
        (fit_affine, lambda x, y: (1.1 * x + 0.1 * y - 0.1, 0.9 * y - 0.05 * x + 0.2)),
        (fit_stretched, lambda x, y: (1.1 * x - 0.1, 0.9 * y + 0.2)),
        (fit_scaled, lambda x, y: (1.07 * x - 0.1, 1.07 * y + 0.2)),
    ):
        model = fit(spots(report))
        for spot in spots(report):
            assert position(model, *spot.mean) == pytest.approx((spot.x, spot.y), abs=1e-9)


def test_a_skewed_world_needs_the_thesis_model_and_a_plain_one_does_not():
    skewed = fit_places(spots(lambda x, y: (1.1 * x + 0.1 * y, 0.9 * y - 0.05 * x), noise=0.05))
    assert skewed.name == "affine"
    plain = [fit_places(spots(lambda x, y: (1.06 * x - 0.05, 1.06 * y - 0.05), 0.2, seed)) for seed in range(8)]
    assert sum(fit.name != "affine" for fit in plain) >= 6
    for fit in plain:
        assert fit.left_out[fit.name] <= fit.left_out["affine"]
