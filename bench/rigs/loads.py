"""`python -m bench.rigs.loads flood|listen|handle|hog|commands`: what makes a robot busy, each a process, until killed.

`flood` publishes 2000 messages of 200 bytes a second on the robot's bus, `listen` takes them, `handle` takes all
messages and does something with each, `hog` computes, `commands` publishes 5000 velocity commands a second, 25 at a
time, and writes each second how many a second there were so far.
"""

import sys
import time

from swarm.bus.zenoh_bus import Bus
from swarm.messages import SetVelocity
from swarm.process.edges import die_with_parent
from swarm.process.paths import runtime_dir

RATE_HZ = 2000.0
SIZE = 200
KEY = "swarm/r0/app/flood/noise"

HANDLER_S = 200e-6
"""What a message costs a process that does something with it."""

COMMANDS_HZ = 200.0
COMMANDS_AT_ONCE = 25


def handle(bus: Bus) -> None:
    """Take all messages, and do something with each."""

    def spin(_key: str, _payload: bytes) -> None:
        end = time.monotonic() + HANDLER_S
        while time.monotonic() < end:
            pass

    bus.subscribe("swarm/**", spin)


def main() -> None:
    """Run one of them."""
    die_with_parent()
    what = sys.argv[1]
    if what == "hog":
        while True:
            pass
    bus = Bus.of(runtime_dir())
    if what == "listen":
        bus.subscribe(KEY, lambda _key, _payload: None)
    elif what == "handle":
        handle(bus)
    began = due = told = time.monotonic()
    sent = 0
    period = {"flood": 1.0 / RATE_HZ, "commands": 1.0 / COMMANDS_HZ}.get(what, 1.0)
    while True:
        if what == "flood":
            bus.publish(KEY, bytes(SIZE))
        elif what == "commands":
            for _ in range(COMMANDS_AT_ONCE):
                bus.publish("swarm/r0/balancer/set/velocity", SetVelocity(0.05, 0.0, 1.0))
            sent += COMMANDS_AT_ONCE
            if (now := time.monotonic()) > told + 1.0:
                told = now
                print(sent / (now - began), flush=True)
        due += period
        time.sleep(max(0.0, due - time.monotonic()))


if __name__ == "__main__":
    main()
