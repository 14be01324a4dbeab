"""`python -m bench.balancer.body TICKS [--in-process]`: a simulated robot's balancer that notes each tick's lateness.

The very program of a simulated robot (`sim.body`). With `--in-process` its process has a Zenoh session of its own
besides, which takes all messages (`bench.rigs.loads.handle`) beside the loop's thread: as the threads of the thesis'
one process did, and the reason why ours are two. At the end TICKS holds pairs of doubles: monotonic time and lateness,
s.
"""

import array
import sys
from collections import deque
from pathlib import Path

from bench.rigs.loads import handle
from services.balancer import loop
from services.balancer.i2c import I2CBus
from sim.devices.wiring import simulated_bus
from swarm import clock
from swarm.bus.zenoh_bus import Bus
from swarm.config import Config
from swarm.process.paths import runtime_dir


def main() -> None:
    """Balance until SIGTERM."""
    ticks = array.array("d")

    class NotedTicks(deque[float]):
        """The loop's row of late starts, which keeps all of them."""

        def append(self, late: float) -> None:
            ticks.extend((clock.now(), late))
            super().append(late)

    vars(loop)["deque"] = NotedTicks
    buses: list[Bus] = []

    def open_bus(config: Config, robot: str) -> I2CBus:
        if "--in-process" in sys.argv:
            buses.append(Bus.of(runtime_dir()))
            handle(buses[0])
        return simulated_bus(config, robot)

    try:
        loop.main(open_bus, start_mode="stand")
    finally:
        for bus in buses:
            bus.close()
        Path(sys.argv[1]).write_bytes(ticks.tobytes())


if __name__ == "__main__":
    main()
