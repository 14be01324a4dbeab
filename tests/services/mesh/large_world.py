"""Large messages in swarms that are joined in memory: made, put in by hand, and looked for."""

from functools import cache

from overlay_world import World, full, line, ring, thesis_d

from services.mesh.core.bulk import pieces
from services.mesh.core.bulk.pieces import Packet
from services.mesh.core.wire.frames import BULK, UNICAST

GRAPHS = {"line": line(4), "ring": ring(5), "full": full(4), "thesis-d": thesis_d()}


@cache
def numbers(count: int) -> bytes:
    return b"".join(b"%06d" % n for n in range(count))


def large(count: int, size: int = 60_000) -> bytes:
    """A payload that shows it if a piece is at the wrong place."""
    return b"%06d" % count + numbers(size // 6 - 1)


def arrived(world: World, name: str, topic: str) -> list[bytes]:
    return [payload for key, payload in world.bots[name].inbox if topic in key]


def idle(world: World) -> bool:
    """Nothing is on its way, and nobody remembers anything of it but what is held for latecomers."""
    for bot in world.bots.values():
        each = bot.overlays._large
        busy = (
            each._exchange._fetches or each._exchange._sources or each._exchange._waiting or each._floods._coming
        ) or (each._transfers._keys or each._transfers._own.messages or each._transfers._own.size)
        if busy:
            return False
    return True


def inject(world: World, name: str, sender: str, packet: Packet) -> None:
    """A packet as a member may make it."""
    data = pieces.encode(packet)
    channel = f"swarm/{sender}/mesh/unicast"
    world.step(name, lambda each: each.receive(sender, UNICAST, channel, data, BULK, world.now))
