"""What tests of the bus share: subscribers that keep what came, and a process that subscribes."""

from collections.abc import Callable

from conftest import wait_until

from swarm.bus.zenoh_bus import Bus

Open = Callable[[], Bus]

HELD_UP = 4.0
"""s that a call takes which waits for Zenoh. A busy machine may hold up one call for as long, but not one after the
other, as Zenoh does."""


class Samples(list[tuple[str, bytes]]):
    """A subscriber's callback that keeps what came."""

    def __call__(self, key: str, payload: bytes) -> None:
        self.append((key, payload))


def talk(bus: Bus, key: str, samples: Samples, payload: bytes = b"hello") -> None:
    """Publish until `samples` has it: a subscription takes effect a moment after it was declared."""

    def arrived() -> bool:
        bus.publish(key, payload)
        return (key, payload) in samples

    wait_until(arrived, what=f"{key} arrives")


SUBSCRIBER = """
import sys
from swarm.bus.zenoh_bus import Bus
count = 0
def callback(key, payload):
    global count
    count += 1
with Bus(sys.argv[1]) as bus:
    bus.subscribe("swarm/**", callback)
    bus.wait_connected(None)
    print("listening", flush=True)
    sys.stdin.read()
"""
