"""The swarms of six that the lab compares with the simulation, as configurations."""

from lab.radio.remote import address

ROBOTS = 6
ITERATIONS = 60

LINE = [(i, i + 1) for i in range(ROBOTS - 1)]
SHAPES = {
    "line": LINE,
}


TIMES = "heartbeat = 1.0\nsuspect = 10.0\ndead = 30.0\n"
"""Longer than normal: a dozen processes on an emulated processor are slow, and none of them is lost for it."""


def config(shape: str, key: str) -> str:
    """The swarm.toml of that shape; `key` is a line of [mesh]."""
    robots = "".join(f'[[robots]]\nname = "r{i}"\nbluetooth = "{address(i)}"\n' for i in range(ROBOTS))
    values = "".join(f"[apps.consensus.robots.r{i}]\nvalue = {(7 * i + 3) / 9!r}\n" for i in range(ROBOTS))
    edges = [[f"r{i}", f"r{j}"] for i, j in SHAPES[shape]]
    return f'network = "lab"\n{robots}[topology]\nedges = {edges}\n[mesh]\n{key}\n{TIMES}{values}'.replace("'", '"')
