"""Who is there, and stopping everybody: both as robots see it while links and processes come and go."""

from collections.abc import Sequence

import pytest
from conftest import costly
from hypothesis import given
from hypothesis import strategies as st
from overlay_world import SILENCE, World, full, line, ring, thesis_d

from services.mesh.core.overlays.stop import (
    CONFIRM_AFTER,
    MAX_NAMED,
    REPEAT_PERIOD,
    SPACING,
    STOP_PERIOD,
    Halt,
    Mark,
    decode_halt,
    encode_halts,
)
from services.mesh.core.routing import membership
from services.mesh.core.routing.membership import PAGE, Membership, Survey
from services.mesh.core.wire import packets
from services.mesh.core.wire.frames import CONTROL, FLOOD
from swarm.messages import Stop, Stopped
from swarm.messages.codec import MAX_PAYLOAD, decode, encode
from swarm.messages.keys import STOP

GRAPHS = {"line": line(6), "loop": ring(6), "thesis-d": thesis_d(), "full": full(4)}
NOTICED = 1.0
"""s in which news of a closed socket, or of a new link, have reached everybody."""


# -- membership ------------------------------------------------------------------------------------------------


def test_robots_that_start_join_the_members() -> None:
    world = World(line(4), start=False)
    world.start("r0")
    world.run(1.0)
    assert set(world.states("r0").values()) == {"never"}
    for name in world.names[1:]:
        world.start(name)
        world.run(NOTICED)
    assert set(world.states("r0").values()) == {"here"}
    assert world.changes("r0") == [("r1", "join"), ("r2", "join"), ("r3", "join")]
    members = {each.robot: each for each in world.bots["r0"].overlays.members(world.now).members}
    assert [(each.hops, each.via) for each in members.values()] == [(1, "r1"), (2, "r1"), (3, "r1")]


def test_leaving_is_told_from_crashing() -> None:
    world = World(full(5))
    world.settle()
    world.leave("r2")
    world.run(NOTICED)
    world.kill("r4")
    world.run(NOTICED)
    for name in ("r0", "r1", "r3"):
        assert world.changes(name)[-2:] == [("r2", "leave"), ("r4", "crash")]
        assert world.states(name)["r2"] == "left"
        assert world.states(name)["r4"] == "gone"


def test_a_robot_returns_as_a_new_one() -> None:
    world = World(ring(5))
    world.settle()
    for end in (world.kill, world.leave):
        end("r2")
        world.run(NOTICED)
        world.start("r2")
        world.run(NOTICED)
        for name in ("r0", "r1", "r3", "r4"):
            assert world.changes(name)[-1] == ("r2", "return")
            assert world.states(name)["r2"] == "here"


def test_a_quick_restart_is_noticed() -> None:
    world = World(full(4))
    world.settle()
    world.kill("r2")
    world.start("r2")
    world.run(NOTICED)
    for name in ("r0", "r1", "r3"):
        assert world.changes(name)[-1] in (("r2", "restart"), ("r2", "return"))


def test_a_partition_and_its_end_are_told_on_both_sides() -> None:
    world = World(line(4))
    world.settle()
    world.cut("r1", "r2")
    world.run(NOTICED)
    assert world.changes("r0")[-2:] == [("r2", "partition"), ("r3", "partition")]
    assert world.changes("r3")[-2:] == [("r0", "partition"), ("r1", "partition")]
    assert world.states("r0") == {"r1": "here", "r2": "gone", "r3": "gone"}
    world.join("r1", "r2")
    world.run(NOTICED)
    assert world.changes("r0")[-2:] == [("r2", "heal"), ("r3", "heal")]
    assert set(world.states("r3").values()) == {"here"}


def test_silence_is_noticed_when_the_link_notices_it() -> None:
    world = World(line(3))
    world.settle()
    world.cut("r1", "r2", silent=True)
    world.run(SILENCE - 0.1)
    assert world.states("r0")["r2"] == "here"
    world.run(NOTICED)
    assert world.changes("r0")[-1] == ("r2", "crash")


def test_changes_are_kept_but_not_without_end() -> None:
    world = World(line(2))
    world.settle()
    for _ in range(membership.KEPT_CHANGES):
        world.cut("r0", "r1")
        world.run(NOTICED)
        world.join("r0", "r1")
        world.run(NOTICED)
    assert len(world.changes("r0")) == membership.KEPT_CHANGES


steps_of = st.lists(
    st.one_of(
        st.tuples(st.just("cut"), st.integers(0, 20), st.integers(0, 1)),
        st.tuples(st.just("join"), st.integers(0, 20), st.just(0)),
        st.tuples(st.just("restart"), st.integers(0, 5), st.integers(0, 1)),
        st.tuples(st.just("stop"), st.integers(0, 5), st.just(0)),
        st.tuples(st.just("arm"), st.integers(0, 5), st.just(0)),
        st.tuples(st.just("wait"), st.floats(0.001, 1.5), st.just(0)),
    ),
    max_size=40,
)


@costly(100)
@given(steps_of, st.sampled_from(sorted(GRAPHS)), st.integers(0, 99))
def test_in_the_end_all_agree_who_is_there_and_whether_to_stand_still(
    steps: Sequence[tuple[str, float, int]], graph: str, seed: int
) -> None:
    world = World(GRAPHS[graph], seed=seed)
    world.run(1.0)
    edges = [sorted(edge) for edge in world.edges]
    for what, value, option in steps:
        name = world.names[int(value) % len(world.names)]
        match what:
            case "cut":
                world.cut(*edges[int(value) % len(edges)], silent=bool(option))
            case "join":
                world.join(*edges[int(value) % len(edges)])
            case "restart":
                (world.leave if option else world.kill)(name)
                world.start(name)
            case "stop":
                stop(world, name)
            case "arm":
                arm(world, name)
            case "wait":
                world.run(value)
    world.run(5.0)
    reachable = {name: {name} for name in world.names}
    for edge, state in world.edges.items():
        if state.up:
            a, b = edge
            union = reachable[a] | reachable[b]
            for name in union:
                reachable[name] = union
    for name in world.names:
        here = {robot for robot, state in world.states(name).items() if state == "here"}
        assert here == reachable[name] - {name}
    for edge in world.edges:
        world.join(*sorted(edge))
    world.run(REPEAT_PERIOD + 2.0)
    for name in world.names:
        assert set(world.states(name).values()) == {"here"}
    assert len({bool(stopped(world, name).by) for name in world.names}) == 1
    # Whatever was before, somebody who sees the whole swarm can arm it, and stop it again.
    arm(world, "r0")
    world.run(NOTICED)
    assert not any(stopped(world, name).stopped for name in world.names)
    stop(world, "r1")
    world.run(NOTICED)
    assert all(stopped(world, name).stopped for name in world.names)


# -- stop ------------------------------------------------------------------------------------------------------


def stop(world: World, name: str, reason: str = "smoke") -> None:
    world.step(name, lambda each: each.stop(Stop(world.now, name, reason), world.now))


def arm(world: World, name: str) -> None:
    world.step(name, lambda each: each.arm(world.now))


def stopped(world: World, name: str) -> Stopped:
    return world.bots[name].overlays.stopped(world.now)


def test_a_stop_reaches_all_at_the_speed_of_the_links() -> None:
    world = World(line(6))
    world.settle()
    began = world.now
    stop(world, "r0", "smoke")
    world.run(0.151)
    for place, name in enumerate(world.names[1:], 1):
        (key, payload) = next(sample for sample in world.bots[name].inbox if sample[0] == STOP)
        assert decode(Stop, payload, key).origin == "r0"
        assert decode(Stop, payload, key).reason == "smoke"
        assert world.bots[name].times[0] - began == pytest.approx(place * 0.03)
        assert stopped(world, name).by == {"r0": "smoke"}


def test_a_stop_costs_no_more_messages_than_a_flood() -> None:
    """And each robot's word that it is stopped costs another one."""
    world = World(thesis_d())
    world.settle()
    world.counting = lambda packet: packet.key.endswith("/halt")
    stop(world, "r0")
    world.run(0.5)
    a_flood = 2 * len(thesis_d()) - (len(world.names) - 1)
    assert world.messages[True] == a_flood
    assert world.messages[False] == len(world.names) * a_flood
    stop(world, "r0", "smoke")
    world.run(0.5)
    assert world.messages[False] == len(world.names) * a_flood, "nothing new to say"


def test_a_stop_is_repeated_on_the_bus_until_it_is_taken_back() -> None:
    world = World(line(3))
    world.settle()
    stop(world, "r0")
    world.run(10.5 * STOP_PERIOD)
    assert 10 <= len(world.got("r2", STOP)) <= 12
    arm(world, "r1")
    world.run(0.1)
    world.clear()
    world.run(10.0)
    assert world.got("r2", STOP) == []
    assert not stopped(world, "r0").stopped


def test_no_late_duplicate_undoes_a_rearm_and_none_undoes_a_stop() -> None:
    world = World(line(3))
    world.settle()
    heard: list[tuple[str, bytes]] = []

    def listen(sender: str, peer: str, packet) -> None:  # type: ignore[no-untyped-def]
        if packet.overlay == FLOOD and packet.key.endswith("/halt") and peer == "r2":
            heard.append((packet.key, packet.payload))

    world.watch = listen
    stop(world, "r0")
    world.run(1.0)
    arm(world, "r0")
    world.run(1.0)
    old = list(heard)
    assert len(old) == 2

    def replay() -> None:
        for key, payload in old * 3:
            world.step("r2", lambda each: each.receive("r1", FLOOD, key, payload, CONTROL, world.now))  # noqa: B023

    replay()
    world.run(1.0)
    assert not any(stopped(world, name).stopped for name in world.names)
    stop(world, "r0", "again")
    world.run(1.0)
    replay()
    world.run(1.0)
    assert all(stopped(world, name).by == {"r0": "again"} for name in world.names)


def test_a_rearm_takes_back_only_what_it_knew_of() -> None:
    world = World(line(4))
    world.settle()
    world.cut("r1", "r2")
    world.run(NOTICED)
    stop(world, "r0", "left half")
    stop(world, "r3", "right half")
    world.run(NOTICED)
    arm(world, "r1")
    world.run(NOTICED)
    assert not stopped(world, "r0").stopped
    world.join("r1", "r2")
    world.run(NOTICED)
    assert all(stopped(world, name).by == {"r3": "right half"} for name in world.names)
    arm(world, "r0")
    world.run(NOTICED)
    assert not any(stopped(world, name).stopped for name in world.names)


def test_who_comes_into_a_stopped_swarm_is_stopped() -> None:
    world = World(line(3), start=False)
    world.start("r0")
    world.start("r1")
    world.run(1.0)
    stop(world, "r0")
    world.run(1.0)
    world.kill("r0")  # the one who stopped it is gone
    world.start("r2")
    world.run(NOTICED)
    assert stopped(world, "r2").by == {"r0": "smoke"}
    world.start("r0")
    world.run(NOTICED)
    assert stopped(world, "r0").stopped
    arm(world, "r0")
    world.run(NOTICED)
    assert not any(stopped(world, name).stopped for name in world.names)


def test_a_stop_of_a_robot_that_forgot_its_earlier_ones_holds() -> None:
    """Even with its clock gone back: what counts is greater than all that it hears of its own past."""
    world = World(line(3))
    world.settle()
    for _ in range(5):
        stop(world, "r0")
        world.run(0.5)
        arm(world, "r2")
        world.run(0.5)
    world.kill("r0")
    world.clock_error["r0"] = -900.0
    world.start("r0")
    world.run(NOTICED)
    stop(world, "r0", "now")
    world.run(NOTICED)
    assert all(stopped(world, name).by == {"r0": "now"} for name in world.names)


def test_stops_in_a_loop_do_not_fill_the_links_and_the_last_one_counts() -> None:
    world = World(line(2))
    world.settle()
    for n in range(100):
        stop(world, "r0", f"{n}")
        world.run(0.001)
    assert world.messages[FLOOD] <= 3
    world.run(SPACING + 0.1)
    assert stopped(world, "r1").by == {"r0": "99"}


def test_a_lost_stop_is_repeated() -> None:
    world = World(line(2))
    world.settle()
    world.loss = 1.0
    stop(world, "r0")
    world.run(1.0)
    assert not stopped(world, "r1").stopped
    world.loss = 0.0
    world.run(REPEAT_PERIOD)
    assert stopped(world, "r1").stopped


def told(world: World, name: str) -> dict[str, bool | None]:
    """Who is stopped by its own word, as one robot has heard."""
    return {each.robot: each.stopped for each in world.bots[name].overlays.graph(world.now).robots}


def test_every_robot_learns_who_has_obeyed() -> None:
    world = World(line(6))
    world.settle()
    assert told(world, "r2") == {"r2": False} | dict.fromkeys(["r0", "r1", "r3", "r4", "r5"])
    stop(world, "r0")
    world.run(2 * 0.15 + CONFIRM_AFTER + 0.001)
    assert told(world, "r0") == dict.fromkeys(world.names, True)
    last = [decode(Stopped, payload, "") for payload in world.got("r0", "swarm/r5/mesh/stopped")]
    assert [each.by for each in last] == [{"r0": "smoke"}]
    arm(world, "r3")
    world.run(1.0)
    for name in world.names:
        assert told(world, name) == dict.fromkeys(world.names, False)


def test_who_was_cut_off_is_not_taken_for_stopped() -> None:
    world = World(line(3))
    world.settle()
    world.cut("r1", "r2")
    world.run(NOTICED)
    stop(world, "r0")
    world.run(NOTICED)
    assert told(world, "r0") == {"r0": True, "r1": True, "r2": None}
    world.join("r1", "r2")
    world.run(NOTICED)
    assert told(world, "r0")["r2"]
    # Nor is one that was started anew by the word of its earlier process.
    world.kill("r1")
    world.run(NOTICED)
    world.kill("r0")
    world.kill("r2")
    world.start("r1")
    world.start("r0")
    world.run(NOTICED)
    assert told(world, "r0") == {"r0": False, "r1": None, "r2": None}


def test_stops_on_all_robots_at_once_make_one_confirmation_of_each() -> None:
    world = World(ring(6))
    world.settle()
    world.counting = lambda packet: packet.key.endswith("/stopped")
    for name in world.names:
        stop(world, name)
    world.run(1.0)
    assert world.messages[True] <= 2 * 6 * (2 * 6 - 5)
    assert told(world, "r4") == dict.fromkeys(world.names, True)


def test_what_is_told_of_a_stop_is_bounded() -> None:
    world = World(line(MAX_NAMED + 4))
    world.settle()
    for name in world.names:
        stop(world, name, "x" * 500)
    world.run(2.0)
    shown = stopped(world, "r0")
    assert shown.stopped
    assert len(shown.by) == MAX_NAMED
    assert len(encode(shown)) < packets.MAX_SPREAD


def test_a_stop_counts_beside_robots_that_are_not_in_the_configuration() -> None:
    world = World(line(2))
    world.settle()
    mark = Mark(2**60, 1)

    def hear(halt: Halt) -> None:
        (data,) = encode_halts(halt)
        world.step("r0", lambda each: each.receive("r1", FLOOD, "swarm/r1/mesh/halt", data, CONTROL, world.now))

    hear(Halt({"r1": (mark, "smoke"), "r9": (mark, "elsewhere")}, {}))
    assert stopped(world, "r0").by == {"r1": "smoke"}
    hear(Halt({}, {"r1": mark, "r9": mark}))
    assert stopped(world, "r0").by == {"r1": "smoke"}, "a re-arm is taken as a whole or not at all"
    assert world.bots["r0"].counters["bad_packets"] == 1
    hear(Halt({}, {"r1": mark}))
    assert not stopped(world, "r0").stopped


def test_a_word_that_is_none_is_a_bad_packet() -> None:
    world = World(line(2))
    world.settle()
    wrong = packets.encode_spread(packets.Spread(2**60, 1, b"no msgpack"))
    world.step("r0", lambda each: each.receive("r1", FLOOD, "swarm/r1/mesh/stopped", wrong, CONTROL, world.now))
    assert world.bots["r0"].counters["bad_packets"] == 1
    assert world.bots["r0"].inbox == []


# -- the whole swarm as one robot knows it ---------------------------------------------------------------------


def test_each_robot_knows_the_whole_graph() -> None:
    world = World(thesis_d())
    world.run(8.0)
    for name in world.names:
        graph = world.bots[name].overlays.graph(world.now)
        assert not graph.more
        found = {frozenset((each.robot, peer)) for each in graph.robots for peer in each.links}
        assert found == set(world.edges)
        (own,) = (each for each in graph.robots if each.state == "self")
        assert (own.robot, own.hops, own.via) == (name, 0, None)
        assert all(each.hops in (1, 2) and each.state == "here" for each in graph.robots if each is not own)
    world.kill("r5")
    world.run(NOTICED)
    (gone,) = (each for each in world.bots["r2"].overlays.graph(world.now).robots if each.robot == "r5")
    assert (gone.state, gone.hops, gone.via) == ("gone", None, None)


class ManyLinks:
    """A map in which every robot has sixteen links, more than any radio has."""

    def __init__(self, names: list[str]) -> None:
        self._names = names

    def links(self, name: str) -> dict[str, int]:
        at = self._names.index(name)
        return {self._names[(at + step) % len(self._names)]: 300 for step in range(1, 17)}


def test_a_large_graph_comes_in_pages_that_fit_the_bus() -> None:
    names = [f"a-long-name-{n:04}" for n in range(2 * PAGE + 50)]
    survey = Survey(names[7], names, Membership(names[7], names, dict), ManyLinks(names), lambda name: 0)  # type: ignore[arg-type]
    found: list[str] = []
    more, after = True, ""
    while more:
        page = survey.graph(1e6, stopped=True, after=after)
        assert len(encode(page)) < MAX_PAYLOAD
        found += [each.robot for each in page.robots]
        more, after = page.more, page.robots[-1].robot
    assert found == names


def test_news_of_strangers_are_refused() -> None:
    world = World(line(2))
    world.settle()
    for halt in (Halt({"r9": (Mark(1, 1), "")}, {}), Halt({}, {"r9": Mark(1, 1)})):
        (data,) = encode_halts(halt)
        assert decode_halt(data) == halt
        world.step(
            "r0", lambda each, data=data: each.receive("r1", FLOOD, "swarm/r1/mesh/halt", data, CONTROL, world.now)
        )
    assert world.bots["r0"].counters["bad_packets"] == 2
    assert not stopped(world, "r0").stopped
