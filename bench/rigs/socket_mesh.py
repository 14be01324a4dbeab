"""A robot's mesh as on a robot: links over stream sockets, authenticated, nothing simulated in its process.

`python -m bench.rigs.socket_mesh` in place of `services.mesh` in a simulation; see `bench.rigs.socket_sim`.
"""

import os
from dataclasses import replace

from bench.rigs import tcp_radio
from services.mesh import __main__ as mesh
from swarm.config import Config, load, who_am_i
from swarm.config.dump import dump
from swarm.config.load import parse
from swarm.process import service
from swarm.process.paths import runtime_dir

PORT, KEY = "BENCH_PORT", "BENCH_KEY"
"""Environment: where all robots listen, each at an address of its own; the file with their key."""


def main() -> None:
    """Give this robot a configuration of its own, and go on as the mesh does."""
    config = load()
    own = runtime_dir() / "mesh.toml"
    own.write_text(dump(_wired(config, who_am_i(config))))
    os.environ["SWARM_CONFIG"] = str(own)
    mesh.main()


def of_robot(config: Config, robot: str) -> Config:
    """The configuration of one robot whose links are such sockets."""
    return parse(dump(_wired(config, robot)), config.path)


def _wired(config: Config, robot: str) -> Config:
    port = os.environ[PORT]
    robots = [replace(each, link=f"tcp:{tcp_radio.in_range(i)}:{port}") for i, each in enumerate(config.robots)]
    listen = f"{tcp_radio.of_robot(config.names.index(robot))}:{port}"
    settings = replace(config.mesh, insecure=False, key=os.environ[KEY], listen=listen)
    return replace(config, robots=tuple(robots), mesh=settings)


if __name__ == "__main__":
    service.run(main)
