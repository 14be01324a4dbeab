"""A robot's mesh as on a robot: links over stream sockets, authenticated, nothing simulated in its process.

`python -m bench.socket_mesh` in place of `services.mesh` in a simulation; see `bench.socket_sim`.
"""

import os
from dataclasses import replace

from bench import radio
from services.mesh import __main__ as mesh
from swarm import service
from swarm.config import load, who_am_i
from swarm.config.dump import dump
from swarm.paths import runtime_dir

PORT, KEY = "BENCH_PORT", "BENCH_KEY"
"""Environment: where all robots listen, each at an address of its own; the file with their key."""


def main() -> None:
    """Give this robot a configuration of its own, and go on as the mesh does."""
    config, port = load(), os.environ[PORT]
    robots = [replace(robot, link=f"tcp:{radio.in_range(i)}:{port}") for i, robot in enumerate(config.robots)]
    listen = f"{radio.of_robot(config.names.index(who_am_i(config)))}:{port}"
    settings = replace(config.mesh, insecure=False, key=os.environ[KEY], listen=listen)
    own = runtime_dir() / "mesh.toml"
    own.write_text(dump(replace(config, robots=tuple(robots), mesh=settings)))
    os.environ["SWARM_CONFIG"] = str(own)
    mesh.main()


if __name__ == "__main__":
    service.run(main)
