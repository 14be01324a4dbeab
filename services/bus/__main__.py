"""The bus of one robot: a Zenoh router on the Unix socket RUNTIME/bus.sock, and nothing on the network.

It listens before it joins its own bus as a service, so that systemd hears READY only when others can connect.
"""

import os
from pathlib import Path

from services.bus.claim import claim
from swarm.bus.zenoh_bus import Router
from swarm.process.paths import bus_endpoint, runtime_dir
from swarm.process.service import Service, die_with_parent, run

UMASK = 0o007
"""Connecting takes write permission on the socket, which follows the umask: owner and group, nobody else."""


ROUTER = "@/*/router"
"""Where a Zenoh router answers queries about itself."""

LOOK_PERIOD_S = 2.0


def main() -> None:
    """Route until SIGTERM or SIGINT."""
    die_with_parent()
    os.umask(UMASK)
    directory: Path = runtime_dir()
    endpoint = bus_endpoint(directory)
    with claim(directory), Router(endpoint), Service("bus") as service:
        service.ready()
        service.log.info("routing endpoint=%s", endpoint)
        # The watchdog is fed by the router's own answers, so that one that no longer routes is replaced.
        while not service.stopping.wait(LOOK_PERIOD_S):
            service.bus.ask(ROUTER, lambda *_: service.watchdog(), timeout_s=LOOK_PERIOD_S)


if __name__ == "__main__":
    run(main, "Run the bus of this robot: a Zenoh router that listens on a Unix socket, and not on the network.")
