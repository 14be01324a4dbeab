"""`python -m bench.loads flood|listen|hog`: what makes a robot busy, each in a process of its own, until it is killed.

`flood` publishes 2000 messages of 200 bytes a second on the robot's bus, `listen` takes them, `hog` computes.
"""

import sys
import time

from swarm.bus import Bus
from swarm.paths import runtime_dir
from swarm.process import die_with_parent

RATE_HZ = 2000.0
SIZE = 200
KEY = "swarm/r0/app/flood/noise"


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
    due = time.monotonic()
    while True:
        if what == "flood":
            bus.publish(KEY, bytes(SIZE))
        due += 1.0 / RATE_HZ if what == "flood" else 1.0
        time.sleep(max(0.0, due - time.monotonic()))


if __name__ == "__main__":
    main()
