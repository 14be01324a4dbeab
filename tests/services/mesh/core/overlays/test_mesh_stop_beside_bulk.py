"""A stop over three links that are full of a large message: it is hardly later than on quiet ones."""

import random
import statistics

import pytest
from conftest import thinned
from mesh_world import World

from swarm.messages import SendRequest, Stop
from swarm.messages.codec import decode
from swarm.messages.keys import STOP

BANDWIDTH = 78_000.0
"""bytes/s of Bluetooth's basic rate, as the thesis' links had it."""
SIZE = 960_000
LINE = [("r0", "r1"), ("r1", "r2"), ("r2", "r3")]


class StopsOnALine:
    """Four robots on a line. r3 stops them, and sends r0 one large message after the other."""

    def __init__(self, **air: float) -> None:
        self.world = World(LINE, **air)  # type: ignore[arg-type]
        self._random = random.Random(1)
        self.messages = 0
        """Large messages that have come."""
        self._requests = 0
        self.world.run(3.0)
        assert self.world.all_up()

    def send(self) -> None:
        """Have one more large message on its way."""
        self._requests += 1
        request = SendRequest(f"s{self._requests}", "x", "r0", bytes(SIZE), "bulk", 300.0)
        self.world.step("r3", lambda node: node.ask(lambda each, now: each.request(request, now), self.world.now))

    def stop(self) -> float:
        """Stop and re-arm at any time; s until r0 has heard of the stop."""
        world, reason = self.world, f"at {self.world.now}"
        inbox, began = world.bots["r0"].inbox, world.now
        inbox.clear()
        stop = Stop(began, "r3", reason)
        world.step("r3", lambda node: node.ask(lambda each, now: each.stop(stop, now), world.now))

        def heard() -> bool:
            return any(key == STOP and decode(Stop, data, key).reason == reason for key, data in inbox)

        assert world.run(5.0, heard)
        took = world.now - began
        world.run(0.1)
        world.step("r3", lambda node: node.ask(lambda each, now: each.arm(now), world.now))
        world.run(0.3 + 0.1 * self._random.random())
        if any("/send/" in key for key, _ in inbox):
            self.messages += 1
            self.send()
        return took

    def beyond(self, count: int) -> list[float]:
        """Beside large messages: by how much so many stops come later than the median of quiet ones, s, sorted."""
        quiet = statistics.median(self.stop() for _ in range(11))
        self.send()
        self.world.run(2.0)
        return sorted(self.stop() - quiet for _ in range(count))


def test_a_large_message_delays_a_stop_over_three_hops_by_less_than_two_ticks() -> None:
    line = StopsOnALine(bandwidth=BANDWIDTH)
    began = line.world.now
    beyond = line.beyond(30)
    assert beyond[-1] <= 0.03
    assert line.messages >= 1
    assert line.messages * SIZE / (line.world.now - began) >= 0.4 * BANDWIDTH, "they are on their way all the time"


@pytest.mark.parametrize(
    ("bandwidth", "latency", "jitter", "most"),
    thinned(
        [
            (40_000.0, 0.03, 0.0, 0.2),
            (200_000.0, 0.03, 0.0, 0.04),
            (BANDWIDTH, 0.005, 0.0, 0.1),
            (BANDWIDTH, 0.03, 0.01, 0.2),
            (10_000.0, 0.03, 0.0, 0.6),
        ]
    ),
)
def test_on_other_links_the_delay_is_bounded_too(bandwidth: float, latency: float, jitter: float, most: float) -> None:
    """The first window is made for 78 kB/s and 60 ms. Where a link is slower, or its round trip shorter, more of it
    stands in the sockets."""
    line = StopsOnALine(bandwidth=bandwidth, latency=latency, jitter=jitter)
    assert line.beyond(30)[-1] <= most
