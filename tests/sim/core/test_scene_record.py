"""What the simulation sees of its robots: LED phases, who stands when, how near they come, how well they are formed."""

import itertools
import math

import pytest

from sim.core import scene_record as scene_record_module
from sim.core import track as track_module
from sim.core.scene_record import SceneRecord
from sim.core.track import MOST_PLACES, TRACK_S, Track


def blinking(offsets: dict[str, float], period: float = 0.5, end: float = 10.0, begin: float = 0.0) -> SceneRecord:
    scene_record = SceneRecord(offsets)
    for name, offset in offsets.items():
        for k in range(round((end - begin) / period)):
            scene_record.leds(name, begin + offset + k * period, yellow=True)
            scene_record.leds(name, begin + offset + (k + 0.5) * period, yellow=False)
    return scene_record


def test_phases_of_neighbours_and_of_all() -> None:
    scene_record = blinking({"r0": 0.0, "r1": 0.004, "r2": 0.010})
    phases = scene_record.phases([("r0", "r1"), ("r1", "r2")], 0.0)
    assert phases.neighbours == pytest.approx(0.006)
    assert phases.all == pytest.approx(0.010)
    assert phases.synchronous_at == pytest.approx(0.0)


def test_one_that_never_blinks_or_blinks_elsewhere_is_not_synchronous() -> None:
    scene_record = blinking({"r0": 0.0, "r1": 0.2})
    assert scene_record.phases([("r0", "r1")], 0.0).neighbours == pytest.approx(0.2)
    assert scene_record.phases([], 0.0).synchronous_at is None
    silent = SceneRecord(["r0", "r1"])
    silent.leds("r0", 1.0, yellow=True)
    assert silent.phases([], 0.0) is None


def test_a_scene_record_has_the_time_from_which_leds_blink_together() -> None:
    scene_record = blinking({"r0": 0.0, "r1": 0.2}, end=5.0)
    for name in ("r0", "r1"):
        for k in range(10):
            scene_record.leds(name, 5.5 + 0.5 * k, yellow=True)
            scene_record.leds(name, 5.75 + 0.5 * k, yellow=False)
    assert scene_record.phases([], 0.0).synchronous_at == pytest.approx(5.5)


def test_an_order_that_is_written_again_is_no_flash() -> None:
    scene_record = SceneRecord(["r0"])
    for t in (1.0, 1.1, 1.2):
        scene_record.leds("r0", t, yellow=True)
    assert list(scene_record.flashes["r0"]) == [1.0]


def test_standing_is_being_upright_for_a_while() -> None:
    scene_record = SceneRecord(["r0"])
    for tick in range(400):
        t = tick * 0.01
        swings = 1.0 <= t < 1.2
        up = t >= 2.0
        scene_record.pose("r0", t, (0.0, 0.0), 0.1 if swings or up else math.radians(110))
        assert up or scene_record.stood_at == {}
    assert scene_record.stood_at == {"r0": pytest.approx(2.0)}
    scene_record.pose("r0", 4.1, (0.0, 0.0), math.radians(-110))
    assert scene_record.stood_at == {}


def test_a_scene_record_knows_where_robots_were_and_how_near() -> None:
    scene_record = SceneRecord(["r0", "r1", "r2"])
    for tick in range(100):
        t = tick * 0.04
        scene_record.pose("r0", t, (0.0, 0.0), 0.0)
        scene_record.pose("r1", t, (1.0 - 0.2 * t, 0.0), 0.0)
        scene_record.pose("r2", t, (0.0, 1.0 + t), 0.0)
    assert scene_record.place("r1", 2.0) == pytest.approx((0.6, 0.0), abs=0.03)
    assert scene_record.place("r1", -1.0) is None


def test_misfit_does_not_mind_where_the_shape_is() -> None:
    scene_record = SceneRecord(["r0", "r1"])
    for tick in range(20):
        t = tick * 0.1
        scene_record.pose("r0", t, (5.0, 5.0), 0.0)
        scene_record.pose("r1", t, (6.0, 5.0 + 0.2 * (t < 1.0)), 0.0)
    misfits = scene_record.misfits({"r0": (0.0, 0.0), "r1": (1.0, 0.0)})
    assert misfits[0][1] == pytest.approx(0.1)
    assert misfits[-1][1] == pytest.approx(0.0)


def test_a_track_of_days_stays_as_large_as_one_of_half_an_hour(monkeypatch):
    monkeypatch.setattr(track_module, "MOST_PLACES", 100)
    track = Track()
    assert track.at(0.0) is None
    for i in range(10_000):
        track.add(TRACK_S * i, (float(i), -float(i)))
        assert len(track) <= 100
    places = list(track)
    assert len(places) >= 50
    assert places[0] == (0.0, (0.0, 0.0))
    times = [t for t, _ in places]
    gaps = [b - a for a, b in itertools.pairwise(times)]
    # Evenly all along, and none is older than the longest gap.
    assert max(gaps) == pytest.approx(min(gaps))
    assert TRACK_S * 9_999 - times[-1] <= max(gaps)
    assert track.at(times[7]) == places[7][1]
    assert track.at(1e9) == places[-1][1]
    assert track.at(-1.0) is None


def test_a_track_takes_half_a_megabyte_at_most():
    assert MOST_PLACES * 24 < 0.5e6


def test_flashes_of_days_are_counted_and_the_first_ones_kept(monkeypatch):
    monkeypatch.setattr(scene_record_module, "MOST_FLASHES", 10)
    scene_record = SceneRecord(["r0"])
    for i in range(25):
        scene_record.leds("r0", float(i), yellow=True)
        scene_record.leds("r0", i + 0.5, yellow=False)
    assert list(scene_record.flashes["r0"]) == [float(i) for i in range(10)]
    assert scene_record.flashed == {"r0": 25}
