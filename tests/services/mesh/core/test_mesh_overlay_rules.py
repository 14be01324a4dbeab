"""Overlays through sessions and relay rules: what leaves, what comes in, and what stays refused."""

from collections.abc import Callable
from dataclasses import replace

import pytest
from conftest import costly
from hypothesis import given
from hypothesis import strategies as st
from mesh_accidents import ACCIDENTS, recover, suffer
from mesh_world import End, World
from raw_hello import KEYS, hello

from services.mesh.core.link import flow
from services.mesh.core.link.outbox import LIMITS
from services.mesh.core.relay import KeyRelay, matches
from services.mesh.core.wire import frames, packets
from services.mesh.core.wire.frames import BULK, FLOOD, MAX_MESSAGE, NEIGHBOURS, SYNC, UNICAST
from services.mesh.core.wire.packets import Spread
from swarm.config.types import DEFAULT_RELAY, RelayRule
from swarm.messages import FloodRequest, SendRequest, Stop

LINE = [("r0", "r1"), ("r1", "r2"), ("r2", "r3")]
RULES = (
    *DEFAULT_RELAY,
    RelayRule("swarm/{self}/dwm/pose", overlay="flood"),
    RelayRule("swarm/{self}/log/*", overlay="flood", queue="all"),
    RelayRule("swarm/{self}/app/*/report/{peer}", overlay="unicast", queue="all"),
    RelayRule("swarm/{peer}/balancer/set/leds", overlay="unicast", priority="sync"),
)


def relay(me: str = "r1", *rules: RelayRule) -> KeyRelay:
    return KeyRelay(me, ("r0", "r2"), rules or RULES, ("r0", "r1", "r2", "r3"))


def legs(relay: KeyRelay, key: str) -> list[tuple[int, tuple[str, ...]]]:
    found = []
    for source, expression in enumerate(relay.subscriptions):
        if matches(expression, key):
            found += [(send.leg.overlay, send.leg.peers) for send in relay.publish(source, key, b"x", 0.0)]
    return found


def source_of(key: str) -> int:
    own = relay("r0")
    return next(n for n, each in enumerate(own.subscriptions) if matches(each, key))


def test_rules_say_where_keys_go() -> None:
    own = relay()
    assert legs(own, "swarm/r1/dwm/pose") == [(FLOOD, ())]
    assert legs(own, "swarm/r1/app/x/report/r3") == [(UNICAST, ("r3",))]
    assert legs(own, "swarm/r3/balancer/set/leds") == [(UNICAST, ("r3",))]
    assert legs(own, "swarm/r1/app/x/sync/a") == [(NEIGHBOURS, ("r0", "r2"))]
    nowhere = (
        "swarm/r0/dwm/pose",
        "swarm/r1/app/x/report/r9",
        "swarm/r1/app/x/report/r1",
        "swarm/r9/balancer/set/leds",
        "swarm/r1/balancer/set/leds",
        "swarm/r3/balancer/set/mode",
        "swarm/r0/app/x/report/r3",
    )
    for key in nowhere:
        assert legs(own, key) == [], key


def test_a_relay_admits_keys_by_overlay_and_rule() -> None:
    own = relay()
    assert own.admits_flood("swarm/r3/dwm/pose")
    assert own.admits_unicast("r3", "swarm/r3/app/x/report/r1")
    assert own.admits_unicast("r3", "swarm/r1/balancer/set/leds")
    assert not own.admits("r0", "swarm/r0/dwm/pose"), "a flooded key is no neighbour's"
    for key in ("swarm/r3/dwm/ranges", "swarm/r3/dwm/set/pose", "swarm/stop", "pose", ""):
        assert not own.admits_flood(key)
    for sender, key in (
        ("r3", "swarm/r3/app/x/report/r2"),
        ("r3", "swarm/r0/app/x/report/r1"),
        ("r3", "swarm/r1/balancer/set/mode"),
        ("r3", "swarm/r0/balancer/set/leds"),
        ("r3", "swarm/r3/app/set/report/r1"),
        ("r3", "swarm/stop"),
    ):
        assert not own.admits_unicast(sender, key), key


def test_wildcards_never_let_commands_through() -> None:
    wild = relay(
        "r1", RelayRule("swarm/{self}/**", overlay="flood"), RelayRule("swarm/{self}/*/*/{peer}", overlay="unicast")
    )
    assert not wild.admits_flood("swarm/r3/balancer/set/mode")
    assert not wild.admits_unicast("r3", "swarm/r3/balancer/set/r1")
    assert legs(wild, "swarm/r1/balancer/set/r3") == []


def test_the_first_rule_decides() -> None:
    rules = (RelayRule("swarm/{self}/a/*"), RelayRule("swarm/{self}/**", overlay="flood"))
    assert legs(relay("r1", *rules), "swarm/r1/a/b") == [(NEIGHBOURS, ("r0", "r2"))]
    assert legs(relay("r1", *rules), "swarm/r1/c/d") == [(FLOOD, ())]
    assert legs(relay("r1", *reversed(rules)), "swarm/r1/a/b") == [(FLOOD, ())]


def test_rules_carry_across_the_swarm() -> None:
    world = World(LINE, rules=RULES)
    world.run(1.0)
    for key in (
        "swarm/r0/dwm/pose",
        "swarm/r0/app/x/report/r3",
        "swarm/r2/balancer/set/leds",
        "swarm/r3/balancer/set/mode",
    ):
        source = source_of(key) if "mode" not in key else 0
        world.publish("r0", key, key.encode(), source)
    world.run(0.2)
    for name, keys in {
        "r1": ["swarm/r0/dwm/pose"],
        "r2": ["swarm/r0/dwm/pose", "swarm/r2/balancer/set/leds"],
        "r3": ["swarm/r0/dwm/pose", "swarm/r0/app/x/report/r3"],
    }.items():
        assert sorted(key for key, _ in world.bots[name].inbox) == sorted(keys)
        assert all(payload == key.encode() for key, payload in world.bots[name].inbox)
    assert world.bots["r0"].inbox == []


def test_a_value_too_long_for_its_overlay_is_counted() -> None:
    world = World(LINE, rules=[RelayRule(rule.keys, overlay=rule.overlay, priority="sync") for rule in RULES])
    world.run(1.0)
    for key, limit in (("swarm/r0/dwm/pose", packets.MAX_SPREAD), ("swarm/r0/app/x/report/r3", packets.UNICAST_ROOM)):
        world.publish("r0", key, bytes(limit + 1), source_of(key))
        world.publish("r0", key, bytes(limit), source_of(key))
    world.run(1.0)
    assert world.bots["r0"].counters["too_large"] == 2
    assert sorted(len(payload) for _, payload in world.bots["r3"].inbox) == [packets.UNICAST_ROOM, packets.MAX_SPREAD]


@pytest.mark.slow
def test_in_the_bulk_class_rules_carry_a_mebibyte() -> None:
    world = World(LINE, rules=RULES)
    world.run(1.0)
    largest = bytes(MAX_MESSAGE)
    for key in ("swarm/r0/dwm/pose", "swarm/r0/app/x/report/r3"):
        world.publish("r0", key, largest, source_of(key))
        world.publish("r0", key, largest + b"!", source_of(key))
    world.run(20.0)
    assert world.bots["r0"].counters["too_large"] == 2
    assert sorted(world.bots["r3"].inbox) == [("swarm/r0/app/x/report/r3", largest), ("swarm/r0/dwm/pose", largest)]
    assert world.bots["r1"].inbox == [("swarm/r0/dwm/pose", largest)]


def test_a_flood_that_finds_a_queue_full_waits_for_it() -> None:
    world = World(LINE, rules=RULES, bandwidth=78_000.0)
    world.run(1.0)
    key = "swarm/r0/log/x"
    count = LIMITS[BULK].messages + 150
    for n in range(count):
        world.publish("r0", key, b"%d" % n, source_of(key))
    assert world.bots["r0"].counters["pushed_back"] > 0
    world.run(10.0)
    assert [payload for _, payload in world.bots["r3"].inbox] == [b"%d" % n for n in range(count)]
    assert all(bot.counters["flood_lost"] == 0 for bot in world.bots.values())
    for n in range(5 * count):
        world.publish("r0", key, b"%d" % n, source_of(key))
    assert world.bots["r0"].counters["flood_lost"] > 0


def test_a_maximum_rate_holds_for_floods() -> None:
    world = World(LINE, rules=[RelayRule("swarm/{self}/dwm/pose", overlay="flood", max_rate=10.0)])
    world.run(1.0)
    for n in range(10):
        world.publish("r0", "swarm/r0/dwm/pose", b"%d" % n)
        world.run(0.01)
    world.run(1.0)
    assert [payload for _, payload in world.bots["r3"].inbox] == [b"0", b"9"]


def test_a_stop_crosses_sessions_and_a_leave_is_heard() -> None:
    world = World(LINE)
    world.run(1.0)
    world.step("r0", lambda node: node.ask(lambda each, now: each.stop(Stop(0.0, "me", "test"), now), world.now))
    world.run(0.1)
    assert any(key == "swarm/stop" for key, _ in world.bots["r3"].inbox)
    world.step("r3", lambda node: node.leave(world.now))
    world.step("r3", lambda node: node.connections.close(world.now))
    world.run(0.5)
    members = world.bots["r0"].node.overlays.members(world.now)
    assert (members.changes[-1].robot, members.changes[-1].what) == ("r3", "leave")


def test_a_neighbour_cannot_bind_what_is_not_its_own() -> None:
    world = World([("r0", "r1"), ("r1", "r2")], rules=RULES)
    world.run(1.0)
    wrong = [
        (FLOOD, "swarm/r2/mesh/digest"),
        (FLOOD, "swarm/r2/mesh/halt"),
        (FLOOD, "swarm/r9/mesh/lsa"),
        (FLOOD, "swarm/r0/mesh/links"),
        (FLOOD, "swarm/r0/balancer/set/mode"),
        (FLOOD, "swarm/r0/app/set/flood/x"),
        (FLOOD, "swarm/stop"),
        (FLOOD, "swarm/r0/app/consensus/sync/a"),
        (UNICAST, "swarm/r2/mesh/unicast"),
        (UNICAST, "swarm/r1/balancer/set/leds"),
        (NEIGHBOURS, "swarm/r0/dwm/pose"),
        (NEIGHBOURS, "swarm/r0/mesh/unicast"),
    ]
    spread = packets.encode_spread(Spread(2**60, 1, b"!"))
    messages = [
        frames.encode_bind(frames.Bind(n, overlay, key)) + frames.encode_data(0, n, spread)
        for n, (overlay, key) in enumerate(wrong)
    ]
    right = frames.encode_bind(frames.Bind(99, FLOOD, "swarm/r0/dwm/pose")) + frames.encode_data(1, 99, spread)
    world.connect_raw("r1", hello(), frames.encode_confirm(), *messages, right)
    world.run(0.2)
    for name in ("r1", "r2"):
        assert world.bots[name].inbox == [("swarm/r0/dwm/pose", b"!")]
    assert world.bots["r1"].counters["inbound_refused"] == len(wrong)
    assert world.link("r1", "r2").connection == 1


@pytest.mark.parametrize("overlay", [3, 255])
def test_unknown_overlays_are_bad_frames(overlay: int) -> None:
    world = World([("r0", "r1")])
    world.run(1.0)
    bind = frames.encode_bind(frames.Bind(1, overlay, "swarm/r0/dwm/pose"))
    world.connect_raw("r1", hello(), frames.encode_confirm(), bind)
    world.run(0.2)
    assert world.bots["r1"].counters["bad_frames"] == 1


def test_bad_packets_do_not_break_links() -> None:
    world = World([("r0", "r1"), ("r1", "r2")])
    world.run(1.0)
    keys = ((FLOOD, "swarm/r0/mesh/lsa"), (FLOOD, "swarm/r0/mesh/digest"), (UNICAST, "swarm/r0/mesh/unicast"))
    parts = [
        frames.encode_bind(frames.Bind(n, overlay, key))
        + b"".join(frames.encode_data(0, n, bytes((kind,)) + b"?") for kind in range(8))
        for n, (overlay, key) in enumerate(keys)
    ]
    caller = world.connect_raw("r1", hello(), frames.encode_confirm(), *parts)
    world.run(0.2)
    assert caller.open
    assert world.bots["r1"].counters["bad_packets"] == 24
    assert world.bots["r1"].counters["bad_frames"] == 0


@costly(25)
@given(st.lists(ACCIDENTS, max_size=20), st.integers(0, 2**16), st.sampled_from((0, 0, 100_000)))
def test_through_links_that_break_everything_is_said_and_nothing_twice(
    steps: list[tuple[str, object]], seed: int, size: int
) -> None:
    """Floods and messages, small or of `size` bytes, between r0 and r2 while the link r0 - r1 is disturbed in every
    way."""
    world = World([("r0", "r1"), ("r1", "r2")], seed=seed)
    world.run(1.0)
    inboxes = []
    for count, (kind, value) in enumerate(steps):
        if kind == "publish":
            for name in ("r0", "r2"):
                if name in world.bots:
                    ask(world, name, count, size)
            continue
        if kind in ("restart", "absent") and value in world.bots:
            inboxes.append((value, world.bots[value].inbox))
        suffer(world, kind, value)
    recover(world)
    world.run(25.0 if not size else 60.0)
    inboxes += [(name, bot.inbox) for name, bot in world.bots.items()]
    for _, inbox in inboxes:
        arrived = [(key, payload) for key, payload in inbox if "/app/" in key]
        assert len(arrived) == len(set(arrived))
    for name, to in (("r0", "r2"), ("r2", "r0")):
        world.bots[to].inbox.clear()
        world.bots[name].inbox.clear()
        ask(world, name, 999, size)
        world.run(1.0 if not size else 20.0)
        assert sorted(key for key, _ in world.bots[to].inbox) == [
            f"swarm/{name}/app/x/flood",
            f"swarm/{name}/app/x/send/{to}",
        ]
        assert len(world.bots[name].inbox) == 2


def ask(world: World, name: str, count: int, size: int = 0) -> None:
    to = "r2" if name == "r0" else "r0"
    payload, priority = (b"%d" % count).ljust(size), "bulk" if size else "sync"
    flood = FloodRequest(f"f{count}", "x", payload, priority, False)
    send = SendRequest(f"s{count}", "x", to, payload, priority, 20.0)
    world.step(name, lambda node: node.ask(lambda each, now: each.request(flood, now), world.now))
    world.step(name, lambda node: node.ask(lambda each, now: each.request(send, now), world.now))


def fragmented(world: World, change: Callable[[End, bytes], bytes] | None = None) -> None:
    """The longest flood and the longest message that one packet holds, from r0 over r1 to r2, in the bulk class: both
    are fragmented on their channels. Meanwhile r1 and r2 talk."""
    world.run(2.0)
    flood = FloodRequest("f", "x", bytes(range(256)) * 20, "bulk", False)
    flood = replace(flood, payload=flood.payload[: packets.MAX_SPREAD])
    send = SendRequest("s", "x", "r2", flood.payload[::-1][: packets.UNICAST_ROOM], "bulk", 20.0)
    world.tap = change
    world.step("r0", lambda node: node.ask(lambda each, now: each.request(flood, now), world.now))
    world.step("r0", lambda node: node.ask(lambda each, now: each.request(send, now), world.now))
    for number in range(100):
        for name in ("r1", "r2"):
            world.publish(name, f"swarm/{name}/app/y/sync/a", number.to_bytes(2, "big"))
        world.run(0.2)
    got = dict(world.bots["r2"].inbox)
    assert got["swarm/r0/app/x/flood"] == flood.payload
    assert got["swarm/r0/app/x/send/r2"] == send.payload
    for name, peer in (("r1", "r2"), ("r2", "r1")):
        heard = [payload for key, payload in world.bots[peer].inbox if key == f"swarm/{name}/app/y/sync/a"]
        assert heard == [number.to_bytes(2, "big") for number in range(100)]


@pytest.mark.parametrize("keys", [None, KEYS])
def test_long_packets_of_overlays_cross_in_fragments_with_and_without_keys(keys: dict[int, bytes] | None) -> None:
    world = World([("r0", "r1"), ("r1", "r2")], keys=keys)
    fragmented(world)
    assert world.bots["r1"].counters["incomplete"] == 0
    assert world.link("r0", "r1").connection == 1


@pytest.mark.parametrize("tampered", [False, True])
def test_a_large_flood_and_a_large_message_cross_authenticated_links_whole(tampered: bool) -> None:
    """Also where somebody on the way flips a bit: that costs a connection, and what was under way goes again."""
    world = World([("r0", "r1"), ("r1", "r2")], keys=KEYS)
    world.run(2.0)
    data = bytes(range(251)) * 240
    flood = FloodRequest("f", "x", data, "bulk", False)
    send = SendRequest("s", "x", "r2", data[::-1], "bulk", 60.0)
    done: list[bytes] = []

    def flip(end: End, written: bytes) -> bytes:
        if tampered and not done and end.robot == "r1" and world.now > 2.5 and len(written) > flow.FRAGMENT:
            done.append(written)
            return written[:200] + bytes((written[200] ^ 4,)) + written[201:]
        return written

    world.tap = flip
    world.step("r0", lambda node: node.ask(lambda each, now: each.request(flood, now), world.now))
    world.step("r0", lambda node: node.ask(lambda each, now: each.request(send, now), world.now))
    world.run(40.0)
    assert bool(done) == tampered
    got = dict(world.bots["r2"].inbox)
    assert got["swarm/r0/app/x/flood"] == data
    assert got["swarm/r0/app/x/send/r2"] == data[::-1]
    assert sum(bot.counters["bad_tags"] for bot in world.bots.values()) == tampered


@pytest.mark.parametrize("change", ["flip", "repeat", "leave out"])
def test_a_fragment_that_is_changed_on_the_way_costs_its_connection_and_nothing_else(change: str) -> None:
    """The message is sent again when the link is back, the flood by repair or by its second try; no wrong byte."""
    world = World([("r0", "r1"), ("r1", "r2")], keys=KEYS)
    done: list[bytes] = []

    def tamper(end: End, data: bytes) -> bytes:
        if end.robot != "r0" or done or data[2] & 0x0F != frames.FRAGMENT:
            return data
        done.append(data)
        middle = len(data) // 2
        match change:
            case "flip":
                return data[:middle] + bytes((data[middle] ^ 1,)) + data[middle + 1 :]
            case "repeat":
                return data + data
            case _:
                return data[:middle]

    fragmented(world, tamper)
    assert done
    assert world.bots["r1"].counters["bad_tags"] == 1
    assert world.link("r0", "r1").connection == 2
    assert world.link("r1", "r2").connection == 1


def test_the_lockstep_path_is_the_one_it_was() -> None:
    """One frame, no overlay header: the bytes of a message to a neighbour are untouched by overlays."""
    world = World([("r0", "r1")])
    world.run(1.0)
    (session,) = world.bots["r0"].ends
    session.data_to_send(world.now, 10_000)
    key = "swarm/r0/app/x/sync/a"
    world.bots["r0"].node.publish(0, key, b"1", world.now)
    first = session.data_to_send(world.now, 10_000)
    world.bots["r0"].node.publish(0, key, b"2", world.now)
    second = session.data_to_send(world.now, 10_000)
    assert len(first) - len(second) == 2 + 1 + 3 + len(key)
    assert len(second) == 5 + 1
    assert second[2] == frames.DATA | SYNC << 4
    assert BULK > SYNC
