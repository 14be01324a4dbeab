"""A link that is held down on command: at either end, for a limited time, and nothing else is harmed."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from mesh_world import World

from services.mesh.core.link.neighbour import MAX_SECONDS, Holds
from swarm.messages import HoldLink

LINE = [("r0", "r1"), ("r1", "r2")]
RECOVERY = 7.0
"""s until the next call of a link that was down for long: 5 s and a quarter of it, and the handshake."""


def hold(world: World, robot: str, peer: str, seconds: float) -> None:
    world.step(robot, lambda node: node.connections.hold(HoldLink(peer, seconds), world.now))


def down(world: World) -> bool:
    return world.link("r0", "r1").state != "up" and world.link("r1", "r0").state != "up"


@pytest.mark.parametrize(("robot", "peer"), [("r0", "r1"), ("r1", "r0")])
@pytest.mark.parametrize("seconds", [0.0, 1.0, 0.07])
def test_one_end_suffices_and_the_link_comes_back(robot: str, peer: str, seconds: float) -> None:
    """Held when it is up, or in its handshake."""
    world = World(LINE)
    world.run(seconds)
    hold(world, robot, peer, 60.0)
    for _ in range(59):
        world.run(1.0)
        assert down(world)
    assert "held down on command" in world.link("r0", "r1").reason
    assert "held down on command" in world.link("r1", "r0").reason or seconds < 1.0  # it was called, and has not met r0
    assert world.link("r1", "r2").state == "up"
    assert world.link("r1", "r2").connection == 1
    world.run(1.0 + RECOVERY)
    assert world.all_up()


@pytest.mark.parametrize(("robot", "peer"), [("r0", "r1"), ("r1", "r0")])
def test_a_held_link_comes_up_on_command_and_after_a_new_start(robot: str, peer: str) -> None:
    world = World(LINE)
    world.run(1.0)
    hold(world, robot, peer, 60.0)
    world.run(10.0)
    assert down(world)
    hold(world, robot, peer, 0.0)
    world.run(RECOVERY)
    assert world.all_up()
    hold(world, robot, peer, 60.0)
    world.run(1.0)
    world.kill(robot)
    world.start(robot)
    world.run(RECOVERY)
    assert world.all_up()


def test_who_is_no_neighbour_is_told_and_changes_nothing() -> None:
    world = World(LINE)
    world.run(1.0)
    for peer in ("r0", "r9", "x" * 1000):
        hold(world, "r0", peer, 60.0)
    world.run(5.0)
    assert world.all_up()
    assert [note.problem for note in world.bots["r0"].notes].count(True) == 3


@given(st.lists(st.tuples(st.sampled_from(("a", "b")), st.floats() | st.floats(-1.0, 900.0))), st.floats(0.0, 1e6))
def test_nothing_is_held_for_longer_than_ten_minutes(wishes: list[tuple[str, float]], now: float) -> None:
    holds, last = Holds(), {"a": 0.0, "b": 0.0}
    for peer, seconds in wishes:
        last[peer] = seconds
        assert holds.take(HoldLink(peer, seconds), now) == (0.0 < seconds < math.inf)
    for peer, seconds in last.items():
        assert holds.holds(peer, now) == (0.0 < seconds < math.inf and now < now + seconds)
        assert not holds.holds(peer, now + MAX_SECONDS)
