"""Attacks by a member: r0 holds the key and has a link to r1, and lies. What it can do and what not is the table in
docs/reference/network/captured-member.md; whatever it does, r1 and r2 lose nothing of what they say to each other."""

from collections.abc import Iterator

import pytest
from attacked_links import SYNC, Watched
from conftest import costly
from hypothesis import given
from hypothesis import strategies as st
from raw_hello import hello

from services.mesh.core.link.outbox import name_of
from services.mesh.core.overlays.stop import Halt, Mark, encode_halts
from services.mesh.core.routing import topology
from services.mesh.core.routing.topology import Advertisement
from services.mesh.core.wire import frames, packets
from services.mesh.core.wire.frames import BULK, CONTROL, FLOOD, MAX_MESSAGE, NEIGHBOURS, UNICAST
from services.mesh.core.wire.packets import Spread, UnicastMessage
from swarm.messages import FloodRequest, Members, Stop
from swarm.messages.codec import decode

SOON = 0.5
"""s in which one lie, and what comes of it, has crossed the links."""

FLOODED = "swarm/{}/app/x/flood"


@pytest.fixture
def watched() -> Iterator[Watched]:
    found = Watched()
    found.world.run(2.0)  # all know each other
    for bot in found.world.bots.values():
        bot.inbox.clear()
    yield found
    found.check_others()


def lie(watched: Watched, overlay: int, key: str, packet: bytes, priority: int = BULK) -> None:
    """Say something in an authenticated frame of r0's link."""
    (session,) = watched.world.bots["r0"].ends
    session.queue.push(priority, name_of(overlay, key), packet, latest=False)
    watched.run(SOON)


def ahead(watched: Watched, robot: str, payload: bytes, sequence: int = 1000) -> bytes:
    """A flood in the name of a robot, newer than all it has said."""
    incarnation = watched.world.bots[robot].node.overlays._flood.incarnation
    return packets.encode_spread(Spread(incarnation, sequence, payload))


def heard(watched: Watched, robot: str, key: str) -> list[bytes]:
    return [payload for each, payload in watched.world.bots[robot].inbox if each == key]


def flood(watched: Watched, robot: str, payload: bytes) -> None:
    request = FloodRequest(f"t{payload.hex()}", "x", payload, "bulk", False)
    world = watched.world
    world.step(robot, lambda node: node.ask(lambda each, now: each.request(request, now), world.now))
    watched.run(SOON)


def test_a_flood_in_anothers_name_arrives_and_the_other_goes_above_it(watched: Watched) -> None:
    """Not protected: r1 takes it for r2's. Protected: r2 is not silenced by it, nor told what it has never said."""
    lie(watched, FLOOD, FLOODED.format("r2"), ahead(watched, "r2", b"forged"))
    assert heard(watched, "r1", FLOODED.format("r2")) == [b"forged"]
    assert heard(watched, "r2", FLOODED.format("r2")) == []
    flood(watched, "r2", b"true")
    assert heard(watched, "r1", FLOODED.format("r2")) == [b"forged", b"true"]
    assert heard(watched, "r0", FLOODED.format("r2"))[-1] == b"true"


@pytest.mark.parametrize(
    ("overlay", "key"),
    [
        (FLOOD, FLOODED.format("r9")),
        (FLOOD, "swarm/r2/balancer/set/mode"),
        (FLOOD, "swarm/r2/dwm/pose"),
        (FLOOD, "swarm/stop"),
        (FLOOD, "swarm/r1/mesh/halt"),
        (FLOOD, "swarm/r2/mesh/digest"),
        (UNICAST, "swarm/r2/mesh/unicast"),
        (NEIGHBOURS, SYNC.format("r2")),
        (NEIGHBOURS, SYNC.format("r1")),
        (NEIGHBOURS, "swarm/r0/balancer/set/mode"),
        (NEIGHBOURS, "swarm/r1/balancer/set/mode"),
    ],
)
def test_no_rule_no_key(watched: Watched, overlay: int, key: str) -> None:
    """Strangers' names, commands, keys without a rule, and what belongs to another link."""
    lie(watched, overlay, key, packet := ahead(watched, "r2", b"forged"))
    assert watched.world.bots["r1"].counters["inbound_refused"] == 1
    for robot in ("r1", "r2"):
        assert not {packet, b"forged"} & set(heard(watched, robot, key))
    assert watched.world.link("r1", "r0").connection == 1, "what is refused harms nobody: the link stays"


def test_nobody_is_told_what_he_has_said_himself(watched: Watched) -> None:
    lie(watched, FLOOD, FLOODED.format("r1"), ahead(watched, "r1", b"forged"))
    assert not heard(watched, "r1", FLOODED.format("r1"))
    assert not heard(watched, "r2", FLOODED.format("r1"))
    flood(watched, "r1", b"true")
    assert heard(watched, "r2", FLOODED.format("r1")) == [b"true"]


def test_a_message_in_anothers_name_needs_a_rule(watched: Watched) -> None:
    for number, (sender, key) in enumerate(
        (
            ("r2", "swarm/r2/app/x/send/r1"),
            ("r2", "swarm/r1/balancer/set/mode"),
            ("r2", "swarm/r0/app/x/send/r1"),
            ("r2", "swarm/r2/app/x/send/r2"),
            ("r1", "swarm/r1/app/x/send/r1"),
        )
    ):
        message = UnicastMessage(
            sender=sender, to="r1", incarnation=2**60, number=100 + number, key=key, payload=b"forged", ttl=32
        )
        lie(watched, UNICAST, "swarm/r0/mesh/unicast", packets.encode_message(message))
    forged = [key for key, payload in watched.world.bots["r1"].inbox if payload == b"forged"]
    assert forged == ["swarm/r2/app/x/send/r1"], "not protected: a message that r2 might have sent"
    assert watched.world.bots["r1"].counters["unicast_refused"] == 4


def test_a_wrong_map_lasts_until_its_owner_speaks(watched: Watched) -> None:
    gone = topology.encode_advertisement(Advertisement({}, leaving=True))
    lie(watched, FLOOD, "swarm/r2/mesh/lsa", ahead(watched, "r2", gone), CONTROL)
    watched.run(2.0)
    world = watched.world
    members = world.bots["r1"].node.overlays.members(world.now)
    assert isinstance(members, Members)
    assert {each.robot: each.state for each in members.members} == {"r0": "here", "r2": "here"}
    flood(watched, "r2", b"true")
    assert heard(watched, "r0", FLOODED.format("r2")) == [b"true"]


def test_stops_and_rearms_can_be_forged_but_given_again(watched: Watched) -> None:
    world = watched.world

    def stopped(robot: str) -> dict[str, str]:
        return dict(world.bots[robot].node.overlays.stopped(world.now).by)

    forged = Halt({"r2": (Mark(2**60, 5), "forged")}, {})
    lie(watched, FLOOD, "swarm/r0/mesh/halt", encode_halts(forged)[0], CONTROL)
    assert stopped("r1") == stopped("r2") == {"r2": "forged"}
    world.step("r1", lambda node: node.ask(lambda each, now: each.arm(now), world.now))
    watched.run(SOON)
    assert stopped("r2") == {}
    lie(watched, FLOOD, "swarm/r0/mesh/halt", encode_halts(forged)[0], CONTROL)
    assert stopped("r1") == {}, "said twice it is old"
    lie(watched, FLOOD, "swarm/r0/mesh/halt", encode_halts(Halt({}, {"r2": Mark(2**61, 7)}))[0], CONTROL)
    stop(watched, "r2")
    assert stopped("r1") == {"r2": "smoke"}
    samples = [decode(Stop, payload, "") for payload in heard(watched, "r1", "swarm/stop")]
    assert samples[-1].reason == "smoke"


def stop(watched: Watched, robot: str) -> None:
    world = watched.world
    world.step(robot, lambda node: node.ask(lambda each, now: each.stop(Stop(now, robot, "smoke"), now), world.now))
    watched.run(SOON)


def test_the_greatest_numbers_there_are_break_nothing(watched: Watched) -> None:
    """They silence their victim's name: above them there is nothing. Meshes go on, and others can stop the swarm."""
    top = Mark(packets.MAX_INCARNATION, 2**32 - 1)
    lie(watched, FLOOD, "swarm/r0/mesh/halt", encode_halts(Halt({}, {"r2": top}))[0], CONTROL)
    lie(watched, FLOOD, FLOODED.format("r2"), packets.encode_spread(Spread(*top, b"forged")))
    lie(watched, FLOOD, "swarm/r2/mesh/lsa", packets.encode_spread(Spread(*top, b"\0\0")), CONTROL)
    stop(watched, "r2")
    flood(watched, "r2", b"silenced")
    world = watched.world
    assert not world.bots["r1"].node.overlays.stopped(world.now).stopped
    stop(watched, "r1")
    assert world.bots["r2"].node.overlays.stopped(world.now).by == {"r1": "smoke"}


def test_a_message_of_four_gigabytes_is_refused_before_anything_is_kept() -> None:
    """A frame's length has two bytes, so the only such field is that of a message in fragments. (Links without keys,
    where everybody is a member and a test can make any frame.)"""
    watched = Watched(keys=None)
    for total in (0xFFFFFFFF, MAX_MESSAGE + 1, 0):
        channel = frames.encode_bind(frames.Bind(9, NEIGHBOURS, SYNC.format("r0")))
        first = frames.encode(
            frames.FRAGMENT, BULK, (9).to_bytes(2, "little") + bytes(2) + total.to_bytes(4, "little") + b"x"
        )
        caller = watched.world.connect_raw("r1", hello(), frames.encode_confirm(), channel, first)
        watched.run(SOON)
        assert not caller.open
    assert watched.world.bots["r1"].counters["bad_frames"] == 3
    watched.world.run(10.0)
    assert watched.world.all_up()
    watched.check_others()


@costly(100)
@given(st.lists(st.tuples(st.sampled_from((FLOOD, UNICAST)), st.integers(0, 5), st.binary(max_size=80)), max_size=8))
def test_whatever_a_member_says_others_lose_nothing(lies: list[tuple[int, int, bytes]]) -> None:
    watched = Watched()
    keys = (
        FLOODED.format("r2"), "swarm/r2/mesh/lsa", "swarm/r0/mesh/halt", "swarm/r0/mesh/digest",
        "swarm/r2/mesh/stopped", "swarm/r0/mesh/unicast",
    )  # fmt: skip
    for overlay, which, packet in lies:
        lie(watched, overlay, keys[5] if overlay == UNICAST else keys[which], packet)
    assert watched.world.link("r1", "r0").connection == 1
    watched.check_others()
