import math
import random
import statistics
from dataclasses import replace

import pytest

from services.dwm.core.module.tlv import LOC_GET, Position, TlvDecoder, encode_location
from sim.core.uwb import ErrorModel, Module, Tag, least_squares_point

QUIET = ErrorModel(1.0, 0.0, heading=0, noise=0, hidden=0, outlier=0, missing=0, engine_offset=0)
PLACES = {
    "D001": (0.0, 0.0),
    "D002": (1.94, 0.0),
    "D003": (1.0, 1.94),
    "C933": (0.5, 1.0),
    "D005": (9.0, 9.0),
}
MODULES = [
    Module(address, *place, 0.0, Position(*place, 0.0, 100 if address != "C933" else 0))
    for address, place in PLACES.items()
]


def errors(model, count=6000, heading=0.0, seed=1):
    """Range errors to D001 from (0.5, 1.5), in m."""
    tag, true = Tag(random.Random(seed), model), math.hypot(0.5, 1.5)
    seen = (tag.measure(MODULES, 0.5, 1.5, heading) for _ in range(count))
    return [item.distance - true for location in seen for item in location.ranges if item.anchor == "D001"]


def test_without_errors_it_is_geometry():
    location = Tag(random.Random(1), QUIET).measure(MODULES, 0.5, 1.5, 0.3)
    assert location.position == Position(0.5, 1.5, 0.0, 60)
    # the nearest four, and the target among them like any other
    assert [item.anchor for item in location.ranges] == ["C933", "D003", "D001", "D002"]
    for item in location.ranges:
        assert item.distance == pytest.approx(math.dist((0.5, 1.5), PLACES[item.anchor]), abs=6e-4)
        assert item.distance == round(item.distance, 3)


def test_simulated_ranges_have_the_slope_offset_and_noise_of_the_model():
    found = errors(replace(ErrorModel(), hidden=0, outlier=0, heading=0))
    true = math.hypot(0.5, 1.5)
    assert statistics.mean(found) == pytest.approx(0.056 * true + 0.063, abs=0.002)
    assert statistics.pstdev(found) == pytest.approx(0.04, abs=0.002)


def test_no_line_of_sight_adds_a_detour():
    found = errors(replace(QUIET, hidden=1.0, hidden_noise=0.10))
    assert statistics.mean(found) == pytest.approx(0.30, abs=0.02)
    assert statistics.pstdev(found) == pytest.approx(math.hypot(0.30, 0.10), abs=0.03)


def test_how_often_things_go_wrong():
    model = replace(QUIET, outlier=0.01, hidden=0.05, hidden_noise=0.0)
    found = errors(model, 20000)
    wild = [error for error in found if error < -0.001]
    assert len(wild) / len(found) == pytest.approx(0.005 * 0.97, abs=0.002)  # the other half are positive
    assert min(wild) > -0.501
    assert sum(error > 0.001 for error in found) / len(found) == pytest.approx(0.055, abs=0.006)
    assert len(errors(replace(QUIET, missing=0.02), 20000)) / 20000 == pytest.approx(0.98, abs=0.004)


def test_the_heading_term_turns_with_the_robot():
    model = replace(QUIET, heading=0.02)
    means = [errors(model, 1, heading=step * math.pi / 8)[0] for step in range(16)]
    assert max(means) == pytest.approx(0.02, abs=0.002)
    assert min(means) == pytest.approx(-0.02, abs=0.002)
    assert errors(model, 1, seed=2) != errors(model, 1, seed=3)


def test_the_position_is_about_as_good_as_the_recorded():
    # The thesis has 3.5 cm rms left after eq. 2.10: the simulated bias at its places is within that.
    tag = Tag(random.Random(5), replace(ErrorModel(), hidden=0, outlier=0, heading=0))
    for place in ((0.5, 1.5), (1.0, 0.5), (1.5, 1.5)):
        fixes = [location.position for location in (tag.measure(MODULES, *place, 0.0) for _ in range(1500))]
        fixes = [fix for fix in fixes if fix.quality > 0]
        x, y = statistics.mean(fix.x for fix in fixes), statistics.mean(fix.y for fix in fixes)
        true_x, true_y = place
        assert 0.93538932 * x + 0.00353817 * y + 0.046239576 == pytest.approx(true_x, abs=0.035)
        assert -0.01071457 * x + 0.94470965 * y + 0.050861534 == pytest.approx(true_y, abs=0.035)
        assert 0.03 < statistics.pstdev(fix.x for fix in fixes) < 0.07


def test_two_anchors_give_no_fix_and_the_old_numbers():
    tag = Tag(random.Random(1), QUIET)
    location = tag.measure(MODULES[:2] + MODULES[3:4], 0.5, 1.5, 0.0)
    assert location.position == Position(0.0, 0.0, 0.0, 0)
    assert len(location.ranges) == 3


def test_a_range_includes_the_difference_in_height():
    tag = Tag(random.Random(1), QUIET)
    (item,) = tag.measure([Module("D001", 0.0, 3.0, 1.0, MODULES[0].known)], 0.0, 0.0, 0.0, 5.0).ranges
    assert item.distance == 5.0


def test_the_position_of_a_tag_above_the_anchors_is_right_too():
    position = Tag(random.Random(1), QUIET).measure(MODULES, 0.5, 1.5, 0.3, 0.5).position
    assert (position.x, position.y) == pytest.approx((0.5, 1.5), abs=3e-3)
    assert position.z == 0.5


def test_one_address_twice_is_ranged_twice():
    tag = Tag(random.Random(1), QUIET)
    assert [item.anchor for item in tag.measure([MODULES[0], MODULES[0]], 0.5, 1.5, 0.0).ranges] == ["D001", "D001"]


def test_between_robots_the_errors_are_those_of_the_model():
    """0.1 m to 4 m, as the thesis asks of distances between robots (2.3)."""
    for true in (0.1, 0.5, 1.0, 2.0, 4.0):
        tag = Tag(random.Random(3), replace(ErrorModel(), hidden=0, outlier=0, heading=0))
        robot = Module("DE01", true, 0.0, 0.0, MODULES[3].known)
        found = [item.distance for _ in range(2000) for item in tag.measure([robot], 0.0, 0.0, 0.0).ranges]
        assert statistics.mean(found) == pytest.approx(1.056 * true + 0.063, abs=0.004)


def test_a_simulated_tag_measures_the_same_with_the_same_seed():
    first, second, other = (Tag(random.Random(seed)) for seed in (1, 1, 2))
    a = [first.measure(MODULES, 0.5, 1.5, 0.1) for _ in range(50)]
    assert a == [second.measure(MODULES, 0.5, 1.5, 0.1) for _ in range(50)]
    assert a != [other.measure(MODULES, 0.5, 1.5, 0.1) for _ in range(50)]


def test_every_measurement_can_be_sent():
    tag, generator = Tag(random.Random(1)), random.Random(2)
    for _ in range(300):
        location = tag.measure(MODULES, generator.uniform(-5, 5), generator.uniform(-5, 5), 0.0)
        decoder = TlvDecoder(LOC_GET)
        decoder.receive(encode_location(location))
        assert decoder.next() == location


@pytest.mark.parametrize(
    ("places", "distances"),
    [
        ([(0, 0, 0), (1, 0, 0)], [1, 1]),
        ([(0, 0, 0), (1, 0, 0), (2, 0, 0)], [1, 0.1, 1]),
        ([], []),
    ],
)
def test_multilateration_knows_when_it_cannot(places, distances):
    assert least_squares_point(places, distances) is None


def test_multilateration_uses_the_anchors_heights():
    places = [(0.0, 0.0, 1.0), (2.0, 0.0, 1.5), (1.0, 2.0, 0.5), (2.0, 2.0, 1.0)]
    distances = [math.dist((0.7, 0.9, 0.0), place) for place in places]
    assert least_squares_point(places, distances) == pytest.approx((0.7, 0.9), abs=1e-4)
