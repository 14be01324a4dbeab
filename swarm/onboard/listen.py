"""The newest value of each key on robots' buses, collected within a moment.

`python -m swarm.onboard.listen ROBOT [SECONDS]` on a robot prints it as JSON; for simulated robots it is called here.
"""

import json
import sys
import threading
import time
from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from swarm.bus.zenoh_bus import Bus
from swarm.errors import PayloadError
from swarm.messages.codec import unpack
from swarm.process.paths import runtime_dir

SECONDS = 6.0
"""The most seconds of listening. If all services of a robot publish, one second is enough."""
LEAST_S = 1.2
"""Least seconds of listening: longer than the period of messages that are sent once a second."""
EXPECTED = ("mesh/status", "balancer/status", "dwm/status", "balancer/state", "mesh/links", "mesh/clock")
"""The keys that a robot without faults publishes."""

STATUS_FROM = ("bus", "mesh", "balancer", "dwm")


def newest_messages(robots: Mapping[str, Path], seconds: float = SECONDS) -> dict[str, dict[str, Any]]:
    """Return the newest messages by robot and topic (`balancer/state`); `bus` says whether the robot has a bus at
    all."""
    found: dict[str, dict[str, Any]] = {robot: {} for robot in robots}
    heard = threading.Event()
    began = time.monotonic()
    with ExitStack() as stack:
        for robot, directory in robots.items():
            bus = stack.enter_context(Bus.of(directory))

            def keep(key: str, payload: bytes, said: dict[str, Any] = found[robot], robot: str = robot) -> None:
                try:
                    value = unpack(payload)
                except PayloadError:
                    return  # an app's own bytes
                if isinstance(value, dict):
                    said[key.removeprefix(f"swarm/{robot}/")] = value
                    heard.set()

            found[robot]["bus"] = bus.wait_connected(2.0)
            if found[robot]["bus"]:
                bus.subscribe([f"swarm/{robot}/*/*", f"swarm/{robot}/app/*/progress"], keep)
                for service in STATUS_FROM:
                    bus.ask(f"swarm/{robot}/{service}/status", keep, timeout_s=seconds)
        while (left := began + seconds - time.monotonic()) > 0:
            heard.clear()
            passed = time.monotonic() - began
            if passed >= LEAST_S and all(topic in said for said in found.values() for topic in EXPECTED if said["bus"]):
                break
            heard.wait(min(left, LEAST_S))
    return found


def main() -> None:
    """Print what is heard on the bus of the robot on which this runs."""
    seconds = float(sys.argv[2]) if len(sys.argv) > 2 else SECONDS
    said = newest_messages({sys.argv[1]: runtime_dir()}, seconds)[sys.argv[1]]
    # Bytes and the like have no place in JSON, and in no check.
    sys.stdout.write(json.dumps(said, default=str) + "\n")


if __name__ == "__main__":
    main()
