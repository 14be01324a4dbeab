"""Unicast under virtual time: shortest paths, once each, another way when links die."""

from collections.abc import Sequence

import pytest
from conftest import costly
from hypothesis import given
from hypothesis import strategies as st
from overlay_world import GRAPHS, SILENCE, World, line, ring

from services.mesh.core.overlays import unicast
from services.mesh.core.routing import link_state
from services.mesh.core.wire import packets
from services.mesh.core.wire.frames import BULK, CONTROL, SYNC, UNICAST
from services.mesh.core.wire.packets import UnicastMessage
from swarm.messages import SendRequest


def test_three_hops_take_three_latencies_and_six_to_be_confirmed() -> None:
    world = World(line(4))
    world.settle()
    began = world.now
    ticket = world.send("r0", "r3", b"hello")
    world.run(1.0)
    assert world.bots["r3"].inbox == [("swarm/r0/app/test/send/r3", b"hello")]
    assert world.bots["r3"].times[0] - began == pytest.approx(0.09)
    sent = world.sent("r0", ticket)
    assert sent is not None
    assert sent.delivered
    assert sent.t - began == pytest.approx(0.18)
    assert world.messages[UNICAST] == 6


def test_each_robot_on_the_way_tells_that_it_has_passed_a_message_and_its_answer_on() -> None:
    world = World(line(4))
    world.settle()
    began = world.now
    ticket = world.send("r0", "r3", b"hello")
    world.run(1.0)
    assert {(it.sender, it.to, it.number) for _, it in world.passed} == {("r0", "r3", 1)}
    told = [(robot, it.next, it.back, it.app, it.ticket, round(it.t - began, 6)) for robot, it in world.passed]
    assert told == [
        ("r0", "r1", False, "test", ticket, 0.0),
        ("r1", "r2", False, "test", "", 0.03),
        ("r2", "r3", False, "test", "", 0.06),
        ("r3", "r2", True, "test", "", 0.09),
        ("r2", "r1", True, "", "", 0.12),
        ("r1", "r0", True, "", "", 0.15),
    ]


def test_a_message_that_goes_another_way_tells_so() -> None:
    world = World(ring(5))
    world.settle()
    world.send("r0", "r2", b"hello")
    world.run(0.01)
    world.cut("r1", "r2")
    world.run(1.0)
    out = [(robot, it.next) for robot, it in world.passed if not it.back]
    assert out == [("r0", "r1"), ("r1", "r0"), ("r0", "r4"), ("r4", "r3"), ("r3", "r2")]


def test_what_relay_rules_carry_is_not_told() -> None:
    world = World(line(3))
    world.settle()
    key = "swarm/r0/rule/set/allowed"
    world.step("r0", lambda overlays: overlays.send("r2", key, b"x", SYNC, world.now, latest=False))
    world.run(1.0)
    assert world.got("r2", "/allowed") == [b"x"]
    assert [it.back for _, it in world.passed] == [True], "on its way an answer does not say to what"


def test_neighbours_and_oneself_can_be_sent_to_at_once() -> None:
    world = World(line(2))
    world.run(0.1)  # the link is up, nobody has told anybody
    for to in ("r0", "r1"):
        ticket = world.send("r0", to, b"x")
        world.run(0.07)
        sent = world.sent("r0", ticket)
        assert sent is not None
        assert sent.delivered
        assert world.got(to, "/send/" + to) == [b"x"]


def test_many_are_in_flight() -> None:
    world = World(line(6))
    world.settle()
    count = 3 * unicast.MAX_IN_FLIGHT
    tickets = [world.send("r0", "r5", b"%d" % n) for n in range(count)]
    world.run(0.16)
    assert len(world.got("r5", "/send/r5")) == unicast.MAX_IN_FLIGHT
    world.run(3.0)
    assert [int(data) for data in world.got("r5", "/send/r5")] == list(range(count))
    assert all(sent.delivered for ticket in tickets if (sent := world.sent("r0", ticket)))
    assert world.bots["r0"].counters["unicast_retries"] == 0


def test_what_is_too_much_is_refused_and_said() -> None:
    world = World(line(2))
    world.settle()
    world.edges[frozenset(("r0", "r1"))].alive = False
    for n in range(unicast.MAX_WAITING):
        world.send("r0", "r1", b"%d" % n)
    cases = {
        world.send("r0", "r1", b"x"): "too many messages wait",
        world.send("r0", "r9", b"x"): "there is no robot r9",
        world.send("r0", "No Name", b"x"): "no robot's name",
        world.send("r1", "r0", bytes(4096)): "at most",
    }
    for ticket, text in cases.items():
        sent = world.sent("r0", ticket) or world.sent("r1", ticket)
        assert sent is not None
        assert not sent.delivered
        assert text in sent.problem


def test_a_lost_message_or_answer_is_sent_again_and_delivered_once() -> None:
    for kind in (packets.MESSAGE, packets.ACK):
        world = World(line(3))
        world.settle()
        edge = world.edges[frozenset(("r1", "r2"))]

        def lose(sender: str, peer: str, packet, edge=edge, kind=kind) -> None:  # type: ignore[no-untyped-def]
            edge.alive = packet.payload[0] != kind

        world.watch = lose
        ticket = world.send("r0", "r2", b"x")
        world.run(0.05 if kind == packets.MESSAGE else 0.13)
        world.watch = None
        edge.alive = True
        world.run(2.0)
        sent = world.sent("r0", ticket)
        assert sent is not None
        assert sent.delivered
        assert world.got("r2", "/send/r2") == [b"x"]
        assert world.bots["r0"].counters["unicast_retries"] == 1
        assert world.bots["r2"].counters["unicast_duplicates"] == (kind == packets.ACK)


def test_a_unicast_message_that_fails_is_answered_with_the_reason() -> None:
    world = World(line(3))
    world.settle()
    world.cut("r1", "r2")
    world.run(1.0)
    lost = world.send("r0", "r2", b"x")
    late = world.send("r0", "r2", b"x", timeout=1.0)
    world.run(1.1)
    sent = world.sent("r0", late)
    assert sent is not None
    assert sent.problem == "no answer from r2 in time"
    world.run(unicast.LEAST_PATIENCE)
    sent = world.sent("r0", lost)
    assert sent is not None
    assert sent.problem == "no way to r2"
    silent = World(line(2))
    silent.settle()
    silent.edges[frozenset(("r0", "r1"))].alive = False
    ticket = silent.send("r0", "r1", b"x")
    silent.run(10.0)
    sent = silent.sent("r0", ticket)
    assert sent is not None
    assert sent.problem == "no answer from r1 after 5 tries"


def test_a_message_waits_for_a_way() -> None:
    world = World(line(3))
    world.settle()
    world.cut("r1", "r2")
    world.run(1.0)
    ticket = world.send("r0", "r2", b"x")
    world.run(1.0)
    world.join("r1", "r2")
    world.run(0.09 + link_state.HOLD_DOWN + 0.2)
    sent = world.sent("r0", ticket)
    assert sent is not None
    assert sent.delivered


def test_a_link_that_closes_in_mid_flight_turns_the_message_round_at_once() -> None:
    """r1 to r4 goes by r0 and r5. The link r5-r4 closes while the message is on it: r5 sends it back, the long way."""
    world = World(ring(6))
    world.settle()
    began = world.now
    route = world.bots["r1"].overlays._map.route("r4")
    assert route is not None
    assert route.next_hop == "r0", "of equal ways the one with the lower name"
    ticket = world.send("r1", "r4", b"x")
    world.run(0.075)
    world.cut("r5", "r4")
    world.run(1.0)
    assert world.got("r4", "/send/r4") == [b"x"]
    sent = world.sent("r1", ticket)
    assert sent is not None
    assert sent.delivered
    assert world.bots["r4"].times[0] - began == pytest.approx(0.075 + 5 * 0.03)
    assert world.bots["r1"].counters["unicast_retries"] == 0
    assert world.bots["r5"].counters["unicast_rerouted"] == 1
    told = [(it.sender, it.to, it.number, it.next, it.app) for robot, it in world.passed if robot == "r5"]
    first = next(it for robot, it in world.passed if robot == "r1")
    assert told == [("r1", "r4", 1, "r4", first.app), ("r1", "r4", 1, "r0", first.app)]


def test_after_a_silent_loss_it_arrives_soon_after_the_silence_is_noticed() -> None:
    world = World(ring(6))
    world.settle()
    world.cut("r0", "r1", silent=True)
    ticket = world.send("r0", "r2", b"x")
    world.run(SILENCE + 5 * 0.03 + 0.2)
    sent = world.sent("r0", ticket)
    assert sent is not None
    assert sent.delivered
    assert world.got("r2", "/send/r2") == [b"x"]


def test_a_robot_on_the_way_dies() -> None:
    world = World(ring(6))
    world.settle()
    ticket = world.send("r0", "r2", b"x")
    world.run(0.031)
    world.kill("r1")
    world.run(0.3)
    sent = world.sent("r0", ticket)
    assert sent is not None
    assert sent.delivered
    assert world.got("r2", "/send/r2") == [b"x"]


def test_news_of_a_dead_link_overtake_what_takes_another_way() -> None:
    """Every robot on the detour knows already: no message runs in circles, however long they are."""
    world = World(ring(20))
    world.settle()
    world.cut("r9", "r10")
    for name in world.names:
        world.send(name, "r10", b"x")
    world.run(3.0)
    assert len(world.got("r10", "/send/r10")) == 20
    assert sum(bot.counters["unicast_expired"] for bot in world.bots.values()) == 0


def test_only_what_a_rule_allows_comes_in() -> None:
    world = World(line(3))
    world.settle()
    for key in ("swarm/r2/balancer/set/mode", "swarm/r2/x/set/allowed", "swarm/r0/app/test/send/r1"):
        world.step("r0", lambda each, key=key: each.send("r2", key, b"x", SYNC, world.now, latest=False))
    world.run(1.0)
    assert world.bots["r2"].inbox == [("swarm/r2/x/set/allowed", b"x")]
    assert world.bots["r2"].counters["unicast_refused"] == 2
    assert not world.bots["r0"].overlays._unicast._own.messages


def test_the_latest_value_replaces_one_that_waits() -> None:
    world = World(line(2))
    world.settle()
    world.edges[frozenset(("r0", "r1"))].alive = False
    key = "swarm/r1/x/set/allowed"
    for n in range(100):
        world.step("r0", lambda each, n=n: each.send("r1", key, b"%d" % n, SYNC, world.now, latest=True))
    assert world.bots["r0"].overlays._unicast._own.messages == 1
    world.edges[frozenset(("r0", "r1"))].alive = True
    world.run(1.0)
    assert world.got("r1", "allowed") == [b"99"]


@pytest.mark.parametrize(("priority", "answer"), [(CONTROL, CONTROL), (SYNC, SYNC), (BULK, SYNC)])
def test_answers_do_not_crowd_the_control_class(priority: int, answer: int) -> None:
    """LSAs wait there, which a burst of answers after a lost link would push out of a full queue."""
    world = World(line(3))
    world.settle()
    classes: dict[int, set[int]] = {packets.MESSAGE: set(), packets.ACK: set()}
    world.watch = lambda sender, peer, packet: classes[packet.payload[0]].add(packet.priority)
    key = "swarm/r2/x/set/allowed"
    world.step("r0", lambda each: each.send("r2", key, b"x", priority, world.now, latest=False))
    world.run(0.5)
    assert classes == {packets.MESSAGE: {priority}, packets.ACK: {answer}}


def test_hops_to_live_are_counted() -> None:
    world = World(line(3))
    world.settle()
    for ttl in (0, 1):
        message = UnicastMessage("r0", "r2", 1, 1, "swarm/r2/x/set/allowed", b"x", ttl)
        data = packets.encode_message(message)
        world.step("r1", lambda each, data=data: each.receive("r0", UNICAST, "swarm/r0/mesh/unicast", data, CONTROL,
                                                               world.now))  # fmt: skip
    world.run(1.0)
    assert world.bots["r1"].counters["unicast_expired"] == 2
    assert not world.bots["r2"].inbox


def test_a_restarted_sender_is_heard_again() -> None:
    world = World(line(2))
    for error in (0.0, -500.0, 500.0):
        world.kill("r0")
        world.clock_error["r0"] = error
        world.start("r0")
        world.settle()
        ticket = world.send("r0", "r1", b"x")
        world.run(1.0)
        sent = world.sent("r0", ticket)
        assert sent is not None
        assert sent.delivered
        assert world.got("r1", "/send/r1") == [b"x"]


accidents = st.lists(
    st.one_of(
        st.tuples(st.just("send"), st.integers(0, 5), st.integers(0, 5)),
        st.tuples(st.just("send"), st.integers(0, 5), st.integers(0, 5)),
        st.tuples(st.just("cut"), st.integers(0, 20), st.integers(0, 1)),
        st.tuples(st.just("join"), st.integers(0, 20), st.just(0)),
        st.tuples(st.just("restart"), st.integers(0, 5), st.just(0)),
        st.tuples(st.just("wait"), st.floats(0.001, 1.5), st.just(0)),
    ),
    max_size=40,
)


@costly(60)
@given(accidents, st.sampled_from(sorted(GRAPHS)), st.floats(0.0, 0.02), st.integers(0, 99))
def test_whatever_happens_delivered_at_most_once_and_said_truly(
    steps: Sequence[tuple[str, float, int]], graph: str, jitter: float, seed: int
) -> None:
    world = World(GRAPHS[graph], jitter=jitter, seed=seed)
    world.run(1.0)
    sent: dict[int, tuple[str, str, int]] = {}
    for count, (what, value, option) in enumerate(steps):
        name = world.names[int(value) % len(world.names)]
        match what:
            case "send":
                to = world.names[option % len(world.names)]
                sent[count] = (name, to, world.lives[name])
                world.send(name, to, b"%d" % count, ticket=f"t{count}")
            case _:
                world.disturb(what, value, option)
    world.run(15.0)
    inboxes = [*world.former, *((name, bot.inbox) for name, bot in world.bots.items())]
    for name, inbox in inboxes:
        arrived = [data for key, data in inbox if "/send/" in key]
        assert len(arrived) == len(set(arrived)), "twice in one life"
        assert all(sent[int(data)][1] == name for data in arrived)
    for count, (name, to, life) in sent.items():
        if life == world.lives[name]:
            answer = world.sent(name, f"t{count}")
            assert answer is not None, "no answer at all"
            arrived = any(
                b"%d" % count in dict.fromkeys(data for _, data in inbox) for who, inbox in inboxes if who == to
            )
            assert arrived or not answer.delivered, "it says that it arrived"
    for edge in world.edges:
        world.join(*sorted(edge))
    world.run(10.0)
    world.clear()
    for name in world.names:
        for to in world.names:
            world.send(name, to, b"end", ticket=f"end-{name}-{to}")
    world.run(1.0)
    for name in world.names:
        assert len(world.got(name, f"/send/{name}")) == len(world.names)
    for bot in world.bots.values():
        assert bot.counters["unicast_retries"] == 0
        assert not bot.overlays._unicast._own.messages
        assert not bot.overlays._unicast._own.size


def test_wrong_requests_to_send_are_answered() -> None:
    world = World(line(2))
    world.settle()
    for ticket, app, priority in (("a", "No App", "sync"), ("b", "x", "soon")):
        request = SendRequest(ticket, app, "r1", b"", priority, 1.0)
        world.step("r0", lambda each, request=request: each.request(request, world.now))
        sent = world.sent("r0", ticket)
        assert sent is not None
        assert sent.problem
