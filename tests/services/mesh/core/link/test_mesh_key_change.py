"""The key of a running swarm is replaced robot by robot, or releases differ: what works after each step, and what is
named (docs/how-to/fleet/replace-the-key.md, Replacing a key)."""

import pytest
from mesh_world import World

from swarm.messages import Stop

LINE = (("r0", "r1"), ("r1", "r2"), ("r2", "r3"))
OLD, NEW = {1: bytes(range(32))}, {2: bytes(range(1, 33))}
RECOVERY = 8.0
"""Seconds within which a link is back after a mesh was started anew: the back-off is 7.5 s at most."""


def restart(world: World, robot: str, keys: dict[int, bytes]) -> None:
    world.kill(robot)
    world.overrides[robot] = {"keys": keys}
    world.start(robot)


def stop_and_arm(world: World, robot: str) -> set[str]:
    """The robots that a stop given on one robot reaches within a second. It is taken back on all robots."""
    order = Stop(world.now, robot, "smoke")
    world.step(robot, lambda node: node.ask(lambda each, now: each.stop(order, now), world.now))
    world.run(1.0)
    found = {name for name, bot in world.bots.items() if bot.node.overlays.stopped(world.now).stopped}
    for name in world.bots:
        world.step(name, lambda node: node.ask(lambda each, now: each.arm(now), world.now))
    world.run(1.0)
    return found


def problems(world: World, name: str) -> list[str]:
    return [note.text for note in world.bots[name].notes if note.problem]


@pytest.mark.parametrize(
    "order", [("r0", "r1", "r2", "r3"), pytest.param(("r2", "r0", "r3", "r1"), marks=pytest.mark.slow)]
)
def test_with_a_file_of_both_keys_a_stop_reaches_all_robots_after_each_step(order: tuple[str, ...]) -> None:
    """Steps of the guide: both keys to each robot, then the new one alone to each robot."""
    world = World(LINE, keys=OLD)
    world.run(2.0)
    for keys in (NEW | OLD, NEW):
        for robot in order:
            restart(world, robot, keys)
            world.run(RECOVERY)
            assert world.all_up()
            for giver in ("r0", "r3", robot):
                assert stop_and_arm(world, giver) == {"r0", "r1", "r2", "r3"}
    assert not any(problems(world, name) for name in world.bots)


def test_a_robot_that_gets_the_new_key_alone_is_alone_named_and_backs_off_until_its_neighbours_have_it() -> None:
    world = World(LINE, keys=OLD)
    world.run(2.0)
    restart(world, "r1", NEW)
    world.run(2.0)
    world.dials.clear()
    world.run(60.0)
    assert len([dial for dial in world.dials if "r1" in dial[1:]]) < 2 * 25, "both links are tried each 5 s"
    assert world.link("r2", "r3").state == "up"
    only = "connection refused peer=r1 reason=robot r1 has another key: 00000002, ours is 00000001"
    assert problems(world, "r0") == [only]
    assert all("has another key" in text for text in problems(world, "r1"))
    assert len(problems(world, "r1")) == 2
    assert stop_and_arm(world, "r2") == {"r2", "r3"}, "over the mesh a stop goes as far as there are links"
    for robot, reached in (("r2", {"r1", "r2"}), ("r0", {"r0", "r1", "r2"}), ("r3", {"r0", "r1", "r2", "r3"})):
        restart(world, robot, NEW)
        world.run(RECOVERY)
        assert stop_and_arm(world, "r1") == reached
    assert world.all_up()


def test_a_stop_given_while_the_keys_differ_is_heard_when_the_link_is_back() -> None:
    world = World(LINE, keys=OLD)
    world.run(2.0)
    restart(world, "r1", NEW)
    world.run(5.0)
    order = Stop(world.now, "r3", "smoke")
    world.step("r3", lambda node: node.ask(lambda each, now: each.stop(order, now), world.now))
    world.run(2.0)
    assert not world.bots["r1"].node.overlays.stopped(world.now).stopped
    restart(world, "r1", NEW | OLD)
    world.run(RECOVERY)
    assert all(bot.node.overlays.stopped(world.now).by == {"r3": "smoke"} for bot in world.bots.values())


def test_a_robot_with_another_version_of_the_protocol_is_refused_and_named_on_both_sides() -> None:
    """r2 has a later release; its version stands in its HELLO."""
    world = World((("r0", "r1"), ("r1", "r2")))
    later = b"BSWM\x04\x04"
    world.tap = lambda end, data: data.replace(b"BSWM\x03\x03", later) if end.robot == "r2" else data
    world.run(60.0)
    assert (world.link("r0", "r1").state, world.link("r0", "r1").connection) == ("up", 1)
    assert world.link("r1", "r2").connection == 0
    assert "speaks protocol versions 4 to 4, we speak 3" in "".join(problems(world, "r1"))
    assert "no common protocol version" in world.link("r2", "r1").reason
    assert len(problems(world, "r1")) == 1
    assert world.bots["r1"].counters["refused_version"] < 30, "it backs off"
