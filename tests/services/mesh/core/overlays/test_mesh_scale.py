"""Many robots under virtual time: messages and bytes for each robot against the formulas
(docs/explanation/overlays.md).

Ring with chords, degree 4. An LSA or a flood without echo crosses 2E - (N - 1) times, a flood with echo 2E, a unicast
message and its answer take two messages a hop.
"""

import gc
from collections.abc import Iterator

import networkx
import pytest
from overlay_world import DATA_OVERHEAD, World, small_world

from services.mesh.core.actions import Transmit
from services.mesh.core.routing.link_state import REFRESH
from services.mesh.core.wire import packets
from services.mesh.core.wire.frames import FLOOD


@pytest.fixture(autouse=True)
def no_collector() -> Iterator[None]:
    """Millions of objects live, none of them garbage: looking through them again and again takes most of the time."""
    gc.disable()
    yield
    gc.enable()


LSA, PLAIN, WAVE, MESSAGE, REPAIR = range(5)

SPREAD_HEADER = 14
LSA_ENTRY = 1 + 2  # length of the name, and a time


def kind_of(packet: Transmit) -> int:
    if packet.overlay != FLOOD:
        return MESSAGE
    match packet.payload[0]:
        case packets.SPREAD if packet.key.endswith("/lsa"):
            return LSA
        case packets.SPREAD:
            return WAVE if packets.decode_spread(packet.payload).echo else PLAIN
        case packets.ECHO:
            return WAVE
        case _:
            return REPAIR


@pytest.mark.parametrize(
    "count",
    [
        30,
        pytest.param(100, marks=pytest.mark.slow),
        pytest.param(300, marks=[pytest.mark.slow, pytest.mark.timeout(300)]),
    ],
)
def test_messages_and_bytes_follow_the_formulas(count: int) -> None:
    edges = small_world(count)
    world = World(edges)
    world.counting = kind_of
    graph = networkx.Graph(edges)
    links, eccentricity = graph.number_of_edges(), networkx.eccentricity(graph, "r0")
    degree = 2 * links / count

    # The start: everybody tells its links once, everybody hears it.
    world.run(0.5 + 0.03 * networkx.diameter(graph))
    assert world.messages[LSA] == count * (2 * links - (count - 1))
    name = sum(map(len, world.names)) / count
    size = SPREAD_HEADER + DATA_OVERHEAD + 2 + degree * (LSA_ENTRY + name)
    assert world.bytes[LSA] == pytest.approx(world.messages[LSA] * size, rel=0.02)
    assert all(len(world.bots[name].overlays._map.routes()) == count - 1 for name in ("r0", f"r{count // 2}"))

    # A flood with its echo.
    world.clear()
    began = world.now
    ticket = world.flood("r0", b"x")
    world.run(0.03 * (2 * eccentricity + 1) + 0.001)
    answer = world.flooded("r0", ticket)
    assert answer is not None
    assert answer.complete
    assert len(answer.robots) == count - 1
    assert world.messages[WAVE] == 2 * links
    reach = max(bot.times[0] for name, bot in world.bots.items() if name != "r0") - began
    assert reach == pytest.approx(0.03 * eccentricity)
    # Names of those behind it are in each robot's echo: N times the mean depth of the tree, some 5 bytes each.
    depth = networkx.single_source_shortest_path_length(graph, "r0")
    names = 5 * sum(depth.values())
    plain = 2 * links * (SPREAD_HEADER + DATA_OVERHEAD + 4)
    assert plain / 2 < world.bytes[WAVE] < plain + 2 * names

    # A message to the far side.
    world.clear()
    to = max(depth, key=lambda name: depth[name])
    sent = world.send("r0", to, b"x")
    world.run(0.06 * eccentricity + 0.001)
    delivered = world.sent("r0", sent)
    assert delivered is not None
    assert delivered.delivered
    assert world.messages[MESSAGE] == 2 * eccentricity

    # A plain flood.
    world.clear()
    world.step("r0", lambda each: each.flood("swarm/r0/rule/x", b"v", 2, world.now, latest=False))
    world.run(1.0 + 0.03 * eccentricity)
    assert world.messages[PLAIN] == 2 * links - (count - 1)
    assert all(world.got(name, "/rule/x") == [b"v"] for name in world.names if name != "r0")

    if count > 100:
        return  # hundreds of thousands of messages a minute would follow
    # Quiet: everybody repeats its LSA once a minute, neighbours compare checksums twice a minute and find them equal.
    world.run(REFRESH / 2)
    world.clear()
    minutes = 2
    world.run(minutes * REFRESH)
    rate = world.messages[LSA] / (minutes * REFRESH) / (2 * links)
    expected = count / REFRESH * (2 * links - (count - 1)) / (2 * links)
    assert rate == pytest.approx(expected, rel=0.05)
    assert world.bytes[REPAIR] < world.bytes[LSA]
    assert sum(bot.counters["repaired"] for bot in world.bots.values()) <= 0.01 * world.messages[LSA]
