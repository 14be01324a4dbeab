import argparse
import itertools
import math
import random

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from services.dwm.anchors.autoposition import align, locate
from services.dwm.anchors.layout import lay_out
from swarm.errors import LocalError

SQUARE = {"D001": (0.0, 0.0), "D002": (2.0, 0.0), "D003": (2.0, 1.5), "D004": (0.2, 1.7)}
coordinates = st.integers(-500, 500).map(lambda value: value / 100)


def between(places):
    return {(a, b): math.dist(places[a], places[b]) for a, b in itertools.combinations(places, 2)}


def thin(places):
    """Whether three of the places are nearly in a line, or two at one place."""
    return any(
        abs((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])) < 0.3
        for a, b, c in itertools.combinations(places, 3)
    )


def test_the_first_is_the_origin_the_second_on_the_axis_the_third_above():
    layout = locate(between(SQUARE))
    for name, place in SQUARE.items():
        assert layout.places[name] == pytest.approx(place, abs=1e-6)
    assert layout.rms < 1e-9


@given(st.lists(st.tuples(coordinates, coordinates), min_size=3, max_size=7))
def test_exact_distances_give_the_layout_back(points):
    assume(not thin(points))
    places = {f"D{index:03}": point for index, point in enumerate(points)}
    layout = locate(between(places))
    assert layout.rms < 1e-6
    aligned = align(layout, places)
    for name, place in places.items():
        assert aligned.places[name] == pytest.approx(place, abs=1e-4)


def test_both_directions_are_averaged_and_residuals_told():
    distances = between(SQUARE)
    distances["D001", "D002"] = 2.05
    distances["D002", "D001"] = 1.95
    assert locate(distances).rms < 1e-9
    distances["D001", "D003"] += 0.10
    layout = locate(distances)
    assert 0.01 < layout.rms < 0.1
    assert layout.residuals["D001", "D003"] == max(layout.residuals.values())


def test_a_pair_that_was_not_measured():
    distances = between(SQUARE)
    del distances["D002", "D004"]
    for name, place in SQUARE.items():
        assert locate(distances).places[name] == pytest.approx(place, abs=1e-6)


def test_an_anchor_that_begins_on_the_wrong_side_of_others_is_found():
    places = {"D001": (3.0, 2.9), "D002": (4.9, 4.4), "D003": (1.5, 1.3), "D004": (4.0, 1.0), "D005": (2.8, 1.2)}
    distances = between(places)
    del distances["D003", "D005"]
    layout = locate(distances)
    assert layout.rms < 1e-6
    aligned = align(layout, places)
    for name, place in places.items():
        assert aligned.places[name] == pytest.approx(place, abs=1e-4)


def test_with_the_noise_of_averaged_ranges_places_are_within_centimetres():
    generator = random.Random(4)
    worst = []
    for _ in range(50):
        noisy = {pair: distance + generator.gauss(0.0, 0.01) for pair, distance in between(SQUARE).items()}
        places = align(locate(noisy), SQUARE).places
        worst.append(max(math.dist(places[name], SQUARE[name]) for name in SQUARE))
    assert max(worst) < 0.05


@pytest.mark.parametrize(("anchors", "shows"), [(3, False), (4, True)])
def test_the_residuals_of_three_anchors_show_no_error_and_the_answer_says_so(anchors, shows, tmp_path, capsys):
    places = dict(itertools.islice(SQUARE.items(), anchors))
    lines = [f"{a} {b} {d + 0.9 * ((a, b) == ('D001', 'D002'))}" for (a, b), d in between(places).items()]
    (tmp_path / "ranges").write_text("\n".join(lines))
    arguments = argparse.Namespace(ranges=tmp_path / "ranges", json=False)
    code = lay_out(arguments, None, (), lambda _, measured: measured, lambda _: None)
    told = capsys.readouterr().out
    assert (code == 1, "check one with a ruler" not in told) == (shows, shows)
    assert "-0.000" not in told


def test_heights_are_taken_out():
    heights = {"D001": 0.0, "D002": 1.0, "D003": 2.0, "D004": 0.5}
    distances = {(a, b): math.hypot(d, heights[a] - heights[b]) for (a, b), d in between(SQUARE).items()}
    layout = locate(distances, heights)
    for name, place in SQUARE.items():
        assert layout.places[name] == pytest.approx(place, abs=1e-6)


def test_alignment_mirrors_where_that_fits_and_not_where_nobody_can_tell():
    layout = locate(between(SQUARE))
    mirrored = {name: (x + 3.0, 1.0 - y) for name, (x, y) in SQUARE.items()}
    for name, place in align(layout, mirrored).places.items():
        assert place == pytest.approx(mirrored[name], abs=1e-6)
    two = {name: mirrored[name] for name in ("D001", "D002")}
    assert align(layout, two).places["D004"] == pytest.approx((3.2, 2.7), abs=1e-6)


@pytest.mark.parametrize(
    ("distances", "message"),
    [
        ({("A", "B"): 1.0}, "2 anchors: three are needed"),
        ({("A", "B"): 1.0, ("B", "C"): 1.0}, "2 distances between 3 anchors do not fix their places"),
        ({("A", "B"): 1.0, ("C", "D"): 1.0}, "fall into groups"),
        ({("A", "B"): 1.0, ("B", "C"): 1.0, ("A", "C"): 2.0}, "in a line"),
        ({("A", "A"): 1.0, ("A", "B"): 1.0, ("B", "C"): 1.0}, "distance from A to A"),
        ({("A", "B"): math.nan, ("A", "C"): 1.0, ("B", "C"): 1.0}, "distance from A to B of nan m"),
        ({("A", "B"): 0.0, ("A", "C"): 1.0, ("B", "C"): 1.0}, "distance from A to B of 0.0 m"),
    ],
)
def test_distances_that_fix_no_layout_are_refused(distances, message):
    with pytest.raises(LocalError, match=message):
        locate(distances)


def test_a_distance_shorter_than_the_climb():
    with pytest.raises(LocalError, match="heights differ"):
        locate({("A", "B"): 1.0, ("A", "C"): 1.0, ("B", "C"): 1.0}, {"A": 2.0})


def test_one_known_place_aligns_nothing():
    with pytest.raises(LocalError, match="two or more"):
        align(locate(between(SQUARE)), {"D001": (0.0, 0.0)})
