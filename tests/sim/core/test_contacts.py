"""Robots that touch: seen, counted, pushed apart and thrown over, in virtual time as by the core alone."""

import math
import re
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.apps.loader import of_class
from services.balancer.core.control.body import body_model
from sim.core.actions import Knock
from sim.core.balboa import BalboaBody
from sim.core.contacts import TOUCH_M, Contacts, Hit
from sim.virtual.run import run_virtually
from swarm import PeriodicApp, parameter, simulate
from swarm.config.types import Body

places = st.tuples(st.floats(-3.0, 3.0), st.floats(-3.0, 3.0))


def meet(speed: float, distance: float = TOUCH_M - 0.01) -> tuple[Contacts, list[Hit]]:
    """Two robots face to face, both at this speed."""
    contacts = Contacts({"r0": 0.4, "r1": 0.4})
    assert contacts.pose("r0", 0.0, (0.0, 0.0), 0.0, speed, 0.0) == []
    return contacts, contacts.pose("r1", 0.0, (distance, 0.0), math.pi, speed, 0.0)


def test_two_that_meet_are_pushed_apart_with_the_momentum_of_their_approach() -> None:
    contacts, hits = meet(0.3)
    assert contacts.count == 1
    assert contacts.contacts[0].speed == pytest.approx(0.6)
    first, second = hits
    assert first.knock(0.0) == Knock(pytest.approx(-0.12), pytest.approx(-0.005), 0.0)
    assert second.knock(math.pi) == Knock(pytest.approx(-0.12), pytest.approx(0.005), 0.0)
    assert second.knock(math.pi / 2).impulse == pytest.approx(0.0)


def test_a_contact_counts_once_until_the_two_are_apart() -> None:
    contacts, _ = meet(0.0)
    for k, distance in enumerate((0.14, 0.149, 0.16, 0.14, 0.2, 0.14), 1):
        contacts.pose("r1", 0.04 * k, (distance, 0.0), math.pi, 0.0, 0.0)
    assert contacts.count == 2
    assert contacts.closest is not None
    assert contacts.closest.distance == pytest.approx(0.14)


def test_one_in_a_hand_feels_nothing() -> None:
    contacts = Contacts({"r0": 0.4, "r1": 0.4})
    contacts.pose("r0", 0.0, (0.0, 0.0), 0.0, 0.0, 0.0, held=True)
    assert contacts.pose("r1", 0.0, (0.1, 0.0), math.pi, 0.3, 0.0) == []
    assert contacts.count == 1


def test_who_falls_after_a_hit_is_named() -> None:
    contacts, _ = meet(0.5)
    contacts.pose("r0", 0.4, (-0.3, 0.0), 0.0, 0.0, math.radians(110))
    contacts.pose("r1", 9.0, (0.6, 0.0), 0.0, 0.0, math.radians(110))
    assert contacts.fallen == [(0.4, "r0")]


@given(st.lists(places, min_size=2, max_size=12))
def test_the_nearest_two_are_those_of_all_pairs(robots: list[tuple[float, float]]) -> None:
    contacts = Contacts({f"r{i}": 0.4 for i in range(len(robots))})
    for i, place in enumerate(robots):
        contacts.pose(f"r{i}", 0.0, place, 0.0, 0.0, 0.0, held=True)
    assert contacts.closest is not None
    assert contacts.closest.distance == min(math.dist(p, q) for i, p in enumerate(robots) for q in robots[:i])


def test_a_body_with_physics_takes_a_hit() -> None:
    body = BalboaBody(body_model("zero2w", Body()), 0.0, held=False)
    body.knock(-0.1, 0.01, 0.02)
    assert (body.x, body.y) == (0.01, 0.02)
    assert body.speed < 0.0
    held = BalboaBody(body_model("zero2w", Body()), 0.0)
    held.knock(-0.1, 0.01, 0.02)
    assert (held.x, held.speed, held.held) == (0.0, 0.0, True)


class Ahead(PeriodicApp):
    """Drive straight on."""

    period = 0.1
    speed: float = parameter(0.3, unit="m/s")
    way: float = 0.0

    def step(self, neighbours: object) -> None:
        """Go on."""
        self.robot.drive(self.speed, 0.0)


SWARM = """
network = "contacts"
robots = [
  { name = "r0", bluetooth = "B8:27:EB:00:00:10" },
  { name = "r1", bluetooth = "B8:27:EB:00:00:11" },
]
topology.shape = "line"
[simulation.places]
r0 = [0.0, 0.0, 0.0]
r1 = [0.6, 0.01, 3.14159]
"""


@pytest.mark.parametrize(("speed", "fall"), [(0.1, False), (0.3, True)])
def test_virtual_robots_push_each_other_and_fall(tmp_path: Path, speed: float, *, fall: bool) -> None:
    file = tmp_path / "swarm.toml"
    file.write_text(SWARM)
    run = simulate(Ahead, config=file, values={"speed": speed}, seconds=5.0, devices=True)
    modes = {sample.message["mode"] for sample in run.recording.samples("swarm/*/balancer/state")}
    assert ("fault" in modes) == fall
    assert run.contacts
    assert run.closest == pytest.approx(TOUCH_M, abs=0.03)


def test_the_times_of_contacts_count_from_the_first_iteration_as_those_of_faults_do(tmp_path: Path) -> None:
    file = tmp_path / "swarm.toml"
    file.write_text(SWARM)
    # With such links the mesh takes seconds to begin, and the robots drive off afterwards.
    words = ["ahead", "--config", str(file), "--latency", "1s", "--seconds", "3"]
    report, outcome = run_virtually(*words, app=of_class(Ahead))
    assert outcome.started_s is not None
    assert outcome.started_s >= 3.0
    assert 0.5 < outcome.scene["closest_after_s"] < 2.5  # type: ignore[operator]
    assert re.match(r"r0-r1 after [12]\.\d s at", report["scene"]["touched"][0])  # type: ignore[index]


def test_robots_that_stand_still_are_measured_too() -> None:
    run = simulate("consensus", iterations=3, faults=["push r1@60s"], progress=False)
    assert run.closest == 0.5
    assert run.contacts == 0
    assert run.never == ("--push r1@60s,0.1: the run ended 0.06 s after its first iteration",)
