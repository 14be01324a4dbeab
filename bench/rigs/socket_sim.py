"""`swarm sim` whose robots link over sockets, with `bench.rigs.tcp_radio` between them.

`python -m bench.rigs.socket_sim ARGUMENTS`, as of `swarm sim`; six robots at most.
"""

import os
import sys
import time
from pathlib import Path

from bench.rigs import socket_mesh
from bench.rigs.ports import free_port
from bench.rigs.running import robots_folder, running
from laptop.cli.runs import sim
from sim.processes import run
from swarm.config.keyfile import new_key_file
from swarm.process import service

ROBOTS = 6


def main() -> int:
    """Start the radio, then the simulation with the other mesh in it."""
    with robots_folder() as home:
        key, port = Path(home) / "key", str(free_port())
        new_key_file(key, time.time())
        os.environ.update({socket_mesh.PORT: port, socket_mesh.KEY: str(key)})
        run.SERVICE_MODULES["mesh"] = "bench.rigs.socket_mesh"
        environment = {**os.environ, "SWARM_PARENT": str(os.getpid())}
        command = [sys.executable, "-m", "bench.rigs.tcp_radio", str(ROBOTS), port]
        with running(command, env=environment):
            return sim.main()


if __name__ == "__main__":
    service.run(main)
