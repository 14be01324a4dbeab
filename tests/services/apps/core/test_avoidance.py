"""Control barrier functions: what is allowed, and that robots that keep to it do not meet."""

import math
import random

import pytest
from conftest import costly, thinned
from driving_world import DrivingWorld
from hypothesis import given
from hypothesis import strategies as st

from services.apps.core import formation
from services.apps.core.avoidance import Barrier, allowed_speed, way_round
from services.apps.core.unicycle import UnicycleLimits, UnicyclePose, drive

BARRIER = Barrier()
COORDINATE = st.floats(-3.0, 3.0)
PLACES = st.lists(st.tuples(COORDINATE, COORDINATE), max_size=8)
ANGLE = st.floats(-10.0, 10.0)
CONTACT = 0.15


def clear_of(others: list[tuple[float, float]], place: tuple[float, float]) -> list[tuple[float, float]]:
    return [other for other in others if math.dist(other, place) >= BARRIER.distance]


def keeps(place: tuple[float, float], u: tuple[float, float], others: list[tuple[float, float]]) -> bool:
    return all((place[0] - x) * u[0] + (place[1] - y) * u[1] >= BARRIER.least(place, (x, y)) - 1e-6 for x, y in others)


@given(st.tuples(COORDINATE, COORDINATE), st.tuples(COORDINATE, COORDINATE), PLACES)
def test_the_way_round_is_allowed_and_no_faster_than_the_limit(place, wish, places) -> None:
    others = clear_of(places, place)
    u = way_round(place, wish, others, BARRIER, 0.2)
    assert math.hypot(*u) <= 0.2 + 1e-9
    assert keeps(place, u, others)


@given(st.tuples(COORDINATE, COORDINATE), st.tuples(COORDINATE, COORDINATE))
def test_where_nobody_is_in_the_way_the_wish_is_what_is_done(place, wish) -> None:
    far = [(place[0] + 5.0, place[1]), (place[0], place[1] - 5.0)]
    pace = max(math.hypot(*wish), 0.2)
    assert way_round(place, wish, far, BARRIER, 0.2) == pytest.approx((0.2 * wish[0] / pace, 0.2 * wish[1] / pace))


@given(st.tuples(COORDINATE, COORDINATE), ANGLE, st.floats(-1.0, 1.0), PLACES)
def test_the_speed_is_allowed_and_standing_always_is(place, heading, wish, places) -> None:
    others = clear_of(places, place)
    speed = allowed_speed(place, heading, wish, others, BARRIER, 0.2)
    assert abs(speed) <= 0.2
    assert keeps(place, (speed * math.cos(heading), speed * math.sin(heading)), others)
    assert keeps(place, (0.0, 0.0), others)
    assert min(0.0, wish) <= speed <= max(0.0, wish), "never more than is wished, nor the other way"


def test_one_that_is_too_near_is_driven_away_from() -> None:
    assert allowed_speed((0.0, 0.0), 0.0, 0.2, [(0.2, 0.0)], BARRIER, 0.2) < -0.05
    assert allowed_speed((0.0, 0.0), 0.0, 0.0, [(-0.2, 0.0)], BARRIER, 0.2) > 0.05
    assert allowed_speed((0.0, 0.0), 0.0, 0.1, [(-0.2, 0.0), (0.2, 0.0)], BARRIER, 0.2) == 0.0


def test_two_that_meet_pass_each_other_on_the_right() -> None:
    left = way_round((0.0, 0.0), (0.2, 0.0), [(0.4, 0.0)], BARRIER, 0.2)
    right = way_round((0.4, 0.0), (-0.2, 0.0), [(0.0, 0.0)], BARRIER, 0.2)
    assert left[1] < -0.05
    assert right[1] > 0.05


def test_one_that_is_nearly_past_another_goes_on() -> None:
    """It does not turn about to go round it on the other side, which would bring it to rest."""
    place, stands, goal = (0.49, 1.05), (0.19, 0.94), (0.575, 0.274)
    far = math.dist(place, goal)
    wish = (0.2 * (goal[0] - place[0]) / far, 0.2 * (goal[1] - place[1]) / far)
    u = way_round(place, wish, [stands], BARRIER, 0.2)
    assert u[0] * wish[0] + u[1] * wish[1] > 0.2 * 0.2**2


@costly(100)
@given(st.integers(0, 10**6), st.integers(2, 6))
def test_without_errors_and_delays_they_keep_apart_whatever_they_wish(seed: int, count: int) -> None:
    """Random wishes, changing all the time; what they need to stop (2 cm) is all they take of the distance."""
    generator = random.Random(seed)
    poses = [UnicyclePose(0.45 * i, 0.45 * (i % 2), generator.uniform(-3, 3)) for i in range(count)]
    world = DrivingWorld(poses, seed, sigma=0.0, delay=0.0)
    for body in world.bodies:
        body._heading_error = 0.0

    def decide(i: int, pose: UnicyclePose, others: list[tuple[float, float]]) -> tuple[float, float]:
        centre = (0.2 * (count - 1) - pose.x, 0.2 - pose.y)
        wish = (centre[0] + generator.uniform(-1, 1), centre[1] + generator.uniform(-1, 1))
        return drive(pose, wish, others, BARRIER, UnicycleLimits())

    world.run(6.0, decide)
    assert world.closest > BARRIER.distance - 0.03


def crossing(seed: int, count: int = 6) -> tuple[list[UnicyclePose], list[tuple[float, float]]]:
    """On a circle, each to about the opposite side."""
    generator = random.Random(f"crossing {seed}")
    turned = generator.uniform(0.0, math.tau)
    poses, goals = [], []
    for i in range(count):
        start, end = (turned + math.tau * i / count + half + generator.gauss(0.0, 0.08) for half in (0.0, math.pi))
        poses.append(UnicyclePose(0.8 * math.cos(start), 0.8 * math.sin(start), generator.uniform(-math.pi, math.pi)))
        goals.append((0.8 * math.cos(end), 0.8 * math.sin(end)))
    return poses, goals


@pytest.mark.parametrize("seed", range(12))
def test_six_cross_without_contact_with_errors_of_an_ekf_and_late_news(seed: int) -> None:
    poses, goals = crossing(seed)
    world = DrivingWorld(poses, seed)

    def decide(i: int, pose: UnicyclePose, others: list[tuple[float, float]]) -> tuple[float, float]:
        way = (goals[i][0] - pose.x, goals[i][1] - pose.y)
        return drive(pose, way if math.hypot(*way) > 0.05 else (0.0, 0.0), others, BARRIER, UnicycleLimits())

    def there() -> bool:
        return all(math.dist(body.place, goal) < 0.12 for body, goal in zip(world.bodies, goals, strict=True))

    assert world.run(60.0, decide, there)
    assert world.closest > CONTACT


@pytest.mark.parametrize("shape", formation.SHAPES)
@pytest.mark.parametrize("seed", thinned(range(3)))
def test_six_drive_into_a_formation_and_stay(shape: str, seed: int) -> None:
    generator = random.Random(f"formation {seed}")
    places = [(0.5, 1.5), (1.0, 0.5), (1.5, 1.5), (1.5, 0.5), (0.35, 0.4), (1.0, 1.75)]
    generator.shuffle(places)
    world = DrivingWorld([UnicyclePose(*place, generator.uniform(-3, 3)) for place in places], seed)
    offsets = [formation.offset(shape, i, 6, 0.6 if shape == "circle" else 0.36) for i in range(6)]
    misfits: list[float] = []

    def decide(i: int, pose: UnicyclePose, others: list[tuple[float, float]]) -> tuple[float, float]:
        known = list(zip(others, offsets[:i] + offsets[i + 1 :], strict=True))
        wish = formation.error((pose.x, pose.y), offsets[i], known)
        return drive(pose, wish if math.hypot(*wish) > 0.02 else (0.0, 0.0), others, BARRIER, UnicycleLimits())

    def measure() -> bool:
        misfits.append(misfit([(b.place, d) for b, d in zip(world.bodies, offsets, strict=True)]))
        return False

    world.run(60.0, decide, measure)
    assert max(misfits[-20:]) < 0.05
    assert world.closest > CONTACT


def misfit(places: list[tuple[tuple[float, float], tuple[float, float]]]) -> float:
    """Root mean square distance of robots from their places in the shape, m; `places`: where each is, its offset."""
    origins = [(p[0] - d[0], p[1] - d[1]) for p, d in places]
    middle = [sum(axis) / len(origins) for axis in zip(*origins, strict=True)]
    return math.sqrt(sum(math.dist(origin, middle) ** 2 for origin in origins) / len(origins))


@given(st.integers(1, 12), st.sampled_from(formation.SHAPES), st.tuples(COORDINATE, COORDINATE))
def test_in_the_shape_there_is_no_error_wherever_it_is(count: int, shape: str, origin: tuple[float, float]) -> None:
    offsets = [formation.offset(shape, i, count, 0.5) for i in range(count)]
    places = [(origin[0] + x, origin[1] + y) for x, y in offsets]
    assert misfit(list(zip(places, offsets, strict=True))) == pytest.approx(0.0, abs=1e-9)
    for i in range(count):
        others = [(places[j], offsets[j]) for j in range(count) if j != i]
        assert formation.error(places[i], offsets[i], others) == pytest.approx((0.0, 0.0), abs=1e-9)
