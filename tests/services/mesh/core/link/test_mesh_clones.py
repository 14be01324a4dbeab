"""Robots that have one name: a copied SD card, or another swarm with the same configuration. The first one keeps its
links, the second is refused by everybody and named, and the others notice nothing
(docs/explanation/two-robots-with-one-name.md)."""

from collections import Counter

import pytest
from conftest import costly
from hypothesis import given
from hypothesis import strategies as st
from mesh_world import World
from raw_hello import hello

from services.mesh.core.link.calls import Caller
from services.mesh.core.link.clock import ClockClaim, encode_claim
from services.mesh.core.wire import frames
from swarm.messages import FloodRequest, Stop

KEYS = {1000: bytes(range(32))}
SYNC = "swarm/{}/app/x/sync/0000000000000001-0-1-00000001"
TRIANGLE = (("r0", "r1"), ("r0", "r2"), ("r1", "r2"))
COPY = "copy of r0"
"""The second robot that is called r0."""


def add_copy(world: World, of: str = "r0", name: str = COPY, **settings: object) -> None:
    """Prepare a robot that has the name, the key and the configuration of another one; `World.start` switches it on."""
    robots = sorted({robot for edge in world.edges for robot in edge})
    world.network[name] = world.network[of]
    world.overrides[name] = {
        "robot": of,
        "robots": frozenset(robots),
        # By name, as for all robots here: the lower one calls.
        "dials": {peer: of < peer for peer in robots if peer != of},
        **settings,
    }


def talk(world: World, rounds: int = 10) -> None:
    """Every robot says something to its neighbours ten times a second; the copy says something else than r0."""
    for _ in range(10 * rounds):
        for name in world.bots:
            robot = world.overrides.get(name, {}).get("robot", name)
            world.publish(name, SYNC.format(robot), f"{name} says so".encode())
        world.run(0.1)


def said(world: World, listener: str) -> set[bytes]:
    return {payload for key, payload in world.bots[listener].inbox if key == SYNC.format("r0")}


def problems(world: World, name: str) -> str:
    return "\n".join(note.text for note in world.bots[name].notes if note.problem)


def clashes(world: World, name: str) -> dict[str, str]:
    return world.bots[name].node.overlays.clashes.named(world.now)


def stop(world: World, robot: str) -> None:
    order = Stop(world.now, robot, "smoke")
    world.step(robot, lambda node: node.ask(lambda each, now: each.stop(order, now), world.now))


def stopped(world: World) -> set[str]:
    return {name for name, bot in world.bots.items() if bot.node.overlays.stopped(world.now).stopped}


@pytest.mark.parametrize("keys", [KEYS, None])
def test_a_second_robot_of_one_name_is_refused_and_the_first_keeps_its_link(keys: dict[int, bytes] | None) -> None:
    world = World((("r0", "r1"), ("r1", "r2")), keys=keys)
    add_copy(world)
    world.run(5.0)
    world.dials.clear()
    world.start(COPY)
    talk(world, 60)
    assert world.all_up()
    assert [world.link("r1", peer).connection for peer in ("r0", "r2")] == [1, 1]
    assert said(world, "r1") == {b"r0 says so"}, "the copy's values are nobody's"
    assert said(world, COPY) == set()
    assert len(world.dials) < 25, "the copy backs off"
    assert world.bots["r1"].counters["refused_clash"] == len(world.dials)
    stop(world, "r2")
    world.run(1.0)
    assert stopped(world) == {"r0", "r1", "r2"}


def test_a_clash_of_names_is_told_to_both_robots_and_to_all_others() -> None:
    world = World((("r0", "r1"), ("r1", "r2")), keys=KEYS)
    add_copy(world)
    world.run(5.0)
    assert clashes(world, "r0") == {}
    world.start(COPY)
    world.run(30.0)
    for name in ("r0", "r1", "r2", COPY):
        assert set(clashes(world, name)) == {"r0"}, name
        assert "r0" in problems(world, name)
        assert "another robot" in problems(world, name)
    assert "another robot" in world.link(COPY, "r1").reason
    noted = {name: len(world.bots[name].notes) for name in world.bots}
    world.run(600.0)
    assert {name: len(world.bots[name].notes) for name in world.bots} == noted, "the log is not filled"
    world.kill(COPY)
    world.run(90.0)
    assert [clashes(world, name) for name in ("r0", "r1", "r2")] == [{}, {}, {}]


def test_a_copy_that_calls_another_neighbour_of_the_swarm_is_refused_there() -> None:
    """r2 has no link with r0, but knows by r0's link state that r1 has one."""
    world = World(TRIANGLE, keys=KEYS)
    add_copy(world)
    world.cut("r0", "r2", 1e9)
    world.cut(COPY, "r1", 1e9)
    world.run(5.0)
    world.start(COPY)
    talk(world, 30)
    assert said(world, "r2") == set()
    assert world.link("r2", "r0").connection == 0
    assert (world.link("r1", "r0").state, world.link("r1", "r0").connection) == ("up", 1)
    assert set(clashes(world, "r0")) == set(clashes(world, COPY)) == {"r0"}


@costly(20)
@given(st.floats(0.001, 2.0), st.integers(0, 1000))
def test_of_two_robots_that_are_switched_on_together_one_keeps_its_links(delay: float, seed: int) -> None:
    world = World(TRIANGLE, keys=KEYS, seed=seed)
    add_copy(world)
    world.cut("r0", "r2", 1e9)
    world.cut(COPY, "r1", 1e9)
    world.run(delay)
    world.start(COPY)
    world.run(60.0)
    up = [world.link(name, "r0").state == "up" for name in ("r1", "r2")]
    assert sorted(up) == [False, True]
    made = [world.link(name, "r0").connection for name in ("r1", "r2")]
    world.run(120.0)
    assert [world.link(name, "r0").connection for name in ("r1", "r2")] == made, "nothing changes any more"
    assert all(set(clashes(world, name)) == {"r0"} for name in world.bots)


def test_the_clock_of_a_second_robot_that_is_refused_after_its_handshake_is_not_followed() -> None:
    """It began its handshake before the first one had its link, and its claim comes with the end of the handshake."""
    world = World((("r0", "r1"),))
    world.cut("r0", "r1", 0.5)
    raw = world.connect_raw("r1", hello(incarnation=7))
    world.run(5.0)
    assert world.link("r1", "r0").state == "up"
    claim = ClockClaim("r0", 7, 1, 0, False, True, world.now, 1000.0, 0.0, 0.0)
    raw.write(frames.encode_confirm() + encode_claim(claim))
    apart = []
    for _ in range(50):
        world.run(0.05)
        apart.append(abs(world.bots["r1"].node.connections.clock.state(world.now).offset))
    assert world.bots["r1"].counters["refused_clash"] == 1
    assert world.link("r1", "r0").connection == 1
    assert max(apart) < 0.01


@pytest.mark.parametrize("silent", [False, True])
def test_a_robot_that_is_started_anew_is_no_copy(silent: bool) -> None:
    """At worst it is refused until the others have noticed that its earlier process is silent."""
    world = World(TRIANGLE, keys=KEYS)
    world.run(5.0)
    for _ in range(10):
        if silent:
            world.cut("r0", "r1", 1.0)
            world.cut("r0", "r2", 0.5)
        world.kill("r0")
        world.start("r0")
        world.run(8.0 if silent else 2.0)
        assert world.all_up()
    assert all(not clashes(world, name) for name in world.bots)
    assert not any("another robot" in problems(world, name) for name in world.bots)


@pytest.mark.slow
def test_two_halves_with_a_robot_of_one_name_each_do_not_make_routes_flap_for_long() -> None:
    """Both links are old when the halves meet, so both stay; the link states take turns, less and less often."""
    edges = (("r0", "r1"), ("r1", "r2"), ("r2", "r3"), ("r0", "r3"))
    world = World(edges, keys=KEYS)
    add_copy(world)
    for pair in (("r0", "r3"), (COPY, "r1"), ("r1", "r2")):
        world.cut(*pair, 60.0 if pair == ("r1", "r2") else 1e9)
    world.start(COPY)
    world.run(60.0)
    assert world.link("r3", "r0").state == world.link("r1", "r0").state == "up"
    world.run(60.0)
    before = Counter({name: world.bots[name].node.overlays._flood.known("r0") for name in ("r1", "r2", "r3")})
    world.run(600.0)
    for name, incarnation in before.items():
        assert world.bots[name].node.overlays._flood.known("r0") - incarnation <= 24, "each half a minute at most"
    assert (world.link("r1", "r0").connection, world.link("r3", "r0").connection) == (1, 1)
    assert all(set(clashes(world, name)) == {"r0"} for name in world.bots)
    stop(world, "r2")
    world.run(2.0)
    assert stopped(world) == set(world.bots)


@pytest.mark.parametrize("keys", [KEYS, None])
def test_floods_and_messages_of_the_others_go_on_beside_a_copy(keys: dict[int, bytes] | None) -> None:
    world = World(TRIANGLE, keys=keys)
    add_copy(world)
    world.start(COPY)
    world.run(20.0)
    for number in range(20):
        request = FloodRequest(f"t{number}", "x", bytes((number,)), "bulk", False)
        world.step(
            "r1", lambda node, request=request: node.ask(lambda each, now: each.request(request, now), world.now)
        )  # type: ignore[misc]
        world.run(1.0)
    heard = [payload for key, payload in world.bots["r2"].inbox if key == "swarm/r1/app/x/flood"]
    assert heard == [bytes((number,)) for number in range(20)]
    assert world.link("r1", "r2").connection == 1


# -- another swarm in range ------------------------------------------------------------------------------------


def foreign_swarm(world: World, **settings: object) -> list[str]:
    """Robots with the same names, each of which calls those of the first swarm (they have the same addresses)."""
    names = {robot: f"foreign {robot}" for robot in ("r0", "r1", "r2")}
    for robot, name in names.items():
        add_copy(world, robot, name, **settings)
        # Its address is that of a neighbour: it is not shut out after a refusal, but backs off by itself.
        world.callers[name] = Caller(f"192.168.0.{robot[1]}", reserved=True)
    return list(names.values())


def test_a_swarm_with_another_key_has_no_effect() -> None:
    world = World(TRIANGLE, keys=KEYS)
    foreign = foreign_swarm(world, keys={2000: bytes(32)})
    world.run(5.0)
    for name in foreign:
        world.start(name)
    noted = {name: len(world.bots[name].notes) for name in ("r0", "r1", "r2")}
    talk(world, 60)
    assert world.all_up()
    assert all(world.link(a, b).connection == 1 for a, b in TRIANGLE)
    for name in ("r0", "r1", "r2"):
        assert clashes(world, name) == {}
        assert len(world.bots[name].notes) - noted[name] <= 1, "one line for all strangers"
        assert not [payload for _, payload in world.bots[name].inbox if b"foreign" in payload]
    assert "robot r0 has another key: 000007d0, ours is 000003e8" in problems(world, "r1")
    assert "robot r1 has another key" in problems(world, "foreign r0"), "it is named on its side, too"


def test_a_swarm_with_the_same_key_and_another_network_is_refused_and_named_on_both_sides() -> None:
    world = World(TRIANGLE, keys=KEYS)
    foreign = foreign_swarm(world, network="other")
    world.run(5.0)
    for name in foreign:
        world.start(name)
    talk(world, 60)
    assert world.all_up()
    assert all(world.link(a, b).connection == 1 for a, b in TRIANGLE)
    assert "network 'other', ours is 'lab'" in problems(world, "r1")
    assert "network 'lab', ours is 'other'" in problems(world, "foreign r0")
    assert all(clashes(world, name) == {} for name in ("r0", "r1", "r2"))


def test_a_swarm_with_the_same_key_and_network_is_a_copy_of_each_robot_and_named() -> None:
    world = World(TRIANGLE, keys=KEYS)
    foreign = foreign_swarm(world)
    world.run(5.0)
    for name in foreign:
        world.start(name)
    talk(world, 60)
    assert world.all_up()
    assert all(world.link(a, b).connection == 1 for a, b in TRIANGLE)
    for name in ("r0", "r1", "r2"):
        assert not [payload for _, payload in world.bots[name].inbox if b"foreign" in payload]
    assert set(clashes(world, "r2")) == {"r0", "r1"}, "these call r2 while it has a link with another one"
    assert "another robot" in problems(world, "foreign r0")


def test_a_stranger_without_the_key_cannot_take_a_name() -> None:
    world = World((("r0", "r1"),), keys=KEYS)
    world.run(2.0)
    raw = world.connect_raw("r1", hello(insecure=False, key_ids=(1000,)), frames.encode_confirm(bytes(32)))
    world.run(3.0)
    assert not raw.open
    assert world.link("r1", "r0").connection == 1
    world.kill("r0")
    raw = world.connect_raw("r1", hello(insecure=False, key_ids=(1000,)), frames.encode_confirm(bytes(32)))
    world.run(1.0)
    assert not raw.open
    assert world.link("r1", "r0").state != "up"
