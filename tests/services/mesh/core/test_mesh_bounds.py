"""Numbers and sizes that a member names: a mesh checks them before it uses them, so none costs it memory or its life.

Each test is an attack by a robot that holds the key. The fuzzers of `bench/decoders/decoders.py` look for further ones.
"""

import tracemalloc
from collections import Counter
from collections.abc import Callable

import pytest
from large_world import inject
from overlay_world import World, line
from topology_world import TopologyWorld

from services.mesh.core.bulk import pieces, transfers
from services.mesh.core.bulk.numbered import SeenNumbers
from services.mesh.core.bulk.pieces import OFFER, MessageId, Packet
from services.mesh.core.link import clock, round_trips
from services.mesh.core.link.clock import ClockClaim, ClockSync, decode_claim, encode_claim
from services.mesh.core.link.flow import Fragment, Reassembly
from services.mesh.core.link.round_trips import Pulse
from services.mesh.core.overlays import unicast
from services.mesh.core.overlays.echo import MAX_WAVES
from services.mesh.core.overlays.robot_overlays import RobotOverlays
from services.mesh.core.routing import topology
from services.mesh.core.routing.membership import PAGE
from services.mesh.core.routing.topology import MAX_STEP, Advertisement
from services.mesh.core.wire import packets
from services.mesh.core.wire.frames import BULK, CONTROL, FLOOD, MAX_MESSAGE, MAX_PAYLOAD, UNICAST, Heartbeat
from services.mesh.core.wire.packets import Spread, UnicastMessage
from swarm.errors import FrameError
from swarm.messages.codec import encode

MIB = 1024 * 1024


def allocated(call: Callable[[], object]) -> int:
    """The most bytes that were allocated at the same time during a call, and not before."""
    tracemalloc.start()
    try:
        call()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def say(world: World, robot: str, sender: str, overlay: int, key: str, packet: bytes, priority: int = BULK) -> None:
    """A packet as a neighbour that is a member may make it."""
    world.step(robot, lambda each: each.receive(sender, overlay, key, packet, priority, world.now))


def test_a_window_allocates_nothing_for_a_number_far_behind_the_highest() -> None:
    window = SeenNumbers(256)
    window.add(2**32 - 1)
    assert allocated(lambda: window.add(2)) < 4096
    assert not window.add(2)
    assert window.has(2)


def test_a_flood_whose_first_try_is_far_behind_allocates_nothing() -> None:
    world = World(line(3))
    world.settle()
    incarnation = world.bots["r2"].overlays._flood.incarnation
    packet = packets.encode_spread(Spread(incarnation, 2**32 - 1, b"x", first=2))
    assert allocated(lambda: say(world, "r1", "r0", FLOOD, "swarm/r2/app/x/flood", packet)) < MIB


def test_a_message_with_a_number_far_behind_allocates_nothing() -> None:
    world = World(line(3))
    world.settle()

    def two() -> None:
        for number in (2**32 - 1, 1):
            message = UnicastMessage("r0", "r1", 7, number, "swarm/r0/app/x/send/r1", b"x", 32)
            say(world, "r1", "r0", UNICAST, "swarm/r0/mesh/unicast", packets.encode_message(message))

    assert allocated(two) < MIB


def test_fragments_of_two_bytes_cost_no_more_than_the_message() -> None:
    """A list of fragments cost 28 times the message, for each of seven neighbours."""
    reassembly = Reassembly(Counter())

    def fill() -> None:
        for number in range(10_000):
            reassembly.add(Fragment(1, number, False, MAX_MESSAGE if not number else 0, b"xy"), 0.0)

    assert allocated(fill) < 3 * 2 * 10_000


def test_an_offer_of_a_flood_is_refused() -> None:
    """It passed by the room of both overlays, and its end escaped the core as a KeyError."""
    world = World(line(3))
    world.settle()
    body = pieces.encode_offer(MAX_MESSAGE, "swarm/r0/app/test/send/r1")
    for number in range(1, 50):
        inject(world, "r1", "r0", Packet(OFFER, "r0", "r1", MessageId("r0", 7, number, flood=True), body, 9))
    assert world.bots["r1"].counters["bad_packets"] == 49
    assert not world.bots["r1"].overlays._large._exchange.fetching
    world.run(60.0)


def test_offers_of_few_bytes_are_refused() -> None:
    """Two million of one byte had room, each with a kilobyte of bookkeeping."""
    world = World(line(3))
    world.settle()
    for number in range(1, 700):
        size = pieces.LEAST_MESSAGE - (number > 600)
        body = pieces.encode_offer(size, "swarm/r0/app/test/send/r1")
        inject(world, "r1", "r0", Packet(OFFER, "r0", "r1", MessageId("r0", 7, number, flood=False), body, 9))
    coming = world.bots["r1"].overlays._large._exchange.fetching
    assert len(coming) == transfers.MAX_COMING_EACH // pieces.LEAST_MESSAGE < 600
    assert world.bots["r1"].counters["bad_packets"] == 99
    with pytest.raises(FrameError, match="are allowed"):
        packets.decode_spread(packets.encode_spread(Spread(1, 1, b"", size=packets.MAX_SPREAD)))


def test_tries_of_one_large_flood_are_remembered_up_to_a_bound() -> None:
    world = World(line(3))
    world.settle()
    incarnation = world.bots["r2"].overlays._flood.incarnation
    for sequence in range(2, 1000):
        spread = Spread(incarnation, sequence, b"", echo=True, first=1, size=MAX_MESSAGE)
        say(world, "r1", "r0", FLOOD, "swarm/r2/app/x/flood", packets.encode_spread(spread))
    (coming,) = world.bots["r1"].overlays._flood.large._coming.values()
    assert len(coming.waves) <= MAX_WAVES


def test_a_packet_that_came_in_fragments_is_not_passed_on() -> None:
    """What was handed to a link lately is kept by the number of packets, 64 of them: of a megabyte each, 64 MiB."""
    world = World(line(3))
    world.settle()
    message = UnicastMessage("r0", "r2", 7, 1, "swarm/r0/app/x/send/r2", bytes(MAX_MESSAGE // 2), 32)
    say(world, "r1", "r0", UNICAST, "swarm/r0/mesh/unicast", packets.encode_message(message))
    spread = packets.encode_spread(Spread(2**60, 1, bytes(MAX_PAYLOAD)))
    say(world, "r1", "r0", FLOOD, "swarm/r0/app/x/flood", spread)
    assert world.bots["r1"].counters["bad_packets"] == 2
    assert not world.bots["r1"].overlays._unicast._custody
    assert unicast.CUSTODY * MAX_PAYLOAD < MIB


def test_decoded_link_states_are_remembered_in_little_memory() -> None:
    """A thousand of four kilobytes each took 28 MB."""

    def flood() -> None:
        for count in range(300):
            names = {f"r{n}": count for n in range(500, 700)}
            topology.decode_advertisement(topology.encode_advertisement(Advertisement(names)))

    assert allocated(flood) < MIB


def test_a_link_state_with_robots_of_no_configuration_is_refused() -> None:
    world = World(line(3))
    world.settle()
    lsa = topology.encode_advertisement(Advertisement({f"stranger{n}": 1 for n in range(150)}))
    say(world, "r1", "r0", FLOOD, "swarm/r2/mesh/lsa", packets.encode_spread(Spread(2**60, 1, lsa)), CONTROL)
    assert world.bots["r1"].counters["bad_packets"] == 1
    assert world.bots["r1"].overlays.graph(world.now).robots[2].links.keys() == {"r1"}


def test_the_graph_fits_the_bus_whatever_links_robots_claim() -> None:
    names = [f"robot-number{n:03}" for n in range(PAGE + 20)]
    overlays = RobotOverlays(names[0], names, incarnation=1, random=lambda: 0.5, counters=Counter())
    claims = topology.encode_advertisement(Advertisement(dict.fromkeys(names, 65535)))
    for name in names[2:]:
        overlays._map.receive(name, 2**60, claims, 1.0)
    shown: list[str] = []
    while True:
        page = overlays.graph(1.0, shown[-1] if shown else "")
        assert len(encode(page)) < 64 * 1024
        shown += [robot.robot for robot in page.robots]
        if not page.more:
            break
    assert shown == names


def test_a_robot_that_hears_robots_beyond_the_configuration_does_not_end_the_planner() -> None:
    world = TopologyWorld(4, auto=True)
    world.run(20.0)
    neighbours = {"r0": 300, "r1": 300, "r2": 300}
    lsa = Advertisement(neighbours, topology=world.linking("r0").tag, heard=(1 << 2040) - 1)
    heard = topology.encode_advertisement(lsa)
    world.bots["r0"].overlays._map.receive("r3", 2**60, heard, world.now)
    world.step("r0", lambda each: each.linking and each.linking._plan(world.now))
    world.run(10.0)
    assert world.graph().number_of_edges() >= 3


def test_the_last_step_of_a_topology_leaves_the_planner_alive() -> None:
    """The next step did not fit its field: each mesh that made a plan ended, and again after its restart."""
    world = TopologyWorld(5, auto=True)
    world.run(20.0)
    linking = world.linking("r0")
    last = linking.value._replace(step=MAX_STEP, issuer="r4")
    channel = "swarm/r1/mesh/topology"
    say(world, "r0", "r1", FLOOD, channel, world.ground.encode(last))
    assert linking.value.step == MAX_STEP
    world.kill("r3")
    world.run(120.0)
    assert linking.value.step == MAX_STEP
    linking.set("line", (), None, world.now)
    assert linking.value.step == 0, "an operator's next topology is above it"


# -- the mesh clock


def claim(**fields: object) -> ClockClaim:
    known = ClockClaim("r0", 1, 1, 0, child=False, settled=True, at=0.0, offset=0.0, rate=0.0, error=0.0)
    return known._replace(**fields)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "lie",
    [
        {"offset": round_trips.MAX_APART, "rate": 1e-3},
        {"offset": -round_trips.MAX_APART, "rate": -1e-3},
        {"error": round_trips.MAX_APART},
        {"at": (2**64 - 2**12) * 1e-6, "rate": -1e-3},
        {"epoch": 2**32 - 1, "hop": 254},
    ],
)
def test_what_a_robot_makes_of_a_claim_is_no_bad_frame_for_the_next_one(lie: dict[str, object]) -> None:
    """A bad frame ends a connection: so a liar could end the links of innocent robots behind it. The robot's own apps
    are told the same time as its neighbours."""
    mesh_clock = ClockSync("r1", 2, frozenset(("r0", "r1", "r2")))
    for second in range(30):
        now = 1e6 + second
        mesh_clock.sample("r0", now, 0.06, round_trips.MAX_APART)
        mesh_clock.hear("r0", claim(**{"epoch": second + 1, **lie}), now)
        told = mesh_clock.claim("r2", now)
        assert decode_claim(encode_claim(told)[3:]).root in ("r0", "r1")
        assert told.offset == mesh_clock.state(now).offset


def test_a_heartbeat_with_wrong_stamps_tells_no_difference_of_clocks() -> None:
    pulse = Pulse(0.0)
    far = 2**64 - 1
    assert pulse.heard(Heartbeat(echo=1, received=far - 1_000_000, sent=far), 1.5) is None
    assert pulse.rtt is None
    assert pulse.heard(Heartbeat(echo=1, received=1_000_000, sent=1_100_000), 1.5) is not None


def test_a_clock_frame_with_numbers_out_of_range_is_refused() -> None:
    good = encode_claim(claim())[3:]
    assert decode_claim(good) == claim()
    layout = clock._CLAIM
    fields = list(layout.unpack_from(good))
    for place, wrong in ((5, float("nan")), (5, 1e11), (6, float("inf")), (6, 0.1), (7, -1.0), (7, float("nan"))):
        changed = [*fields[:place], wrong, *fields[place + 1 :]]
        with pytest.raises(FrameError, match="out of bounds"):
            decode_claim(layout.pack(*changed) + b"r0")
