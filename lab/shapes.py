"""The swarms of six that the lab compares with the simulation, as configurations."""

from lab.radio.remote import address

ROBOTS = 6
ITERATIONS = 60

LINE = [(i, i + 1) for i in range(ROBOTS - 1)]
SHAPES = {
    "line": LINE,
    "loop": [*LINE, (0, ROBOTS - 1)],
    "random": [(0, 2), (0, 3), (1, 3), (1, 4), (2, 5), (3, 4), (4, 5)],
    "full": [(i, j) for i in range(ROBOTS) for j in range(i + 1, ROBOTS)],
}


def config(shape: str, key: str) -> str:
    """The swarm.toml of that shape; `key` is a line of [mesh]."""
    robots = "".join(f'[[robots]]\nname = "r{i}"\nbluetooth = "{address(i)}"\n' for i in range(ROBOTS))
    values = "".join(f"[apps.consensus.robots.r{i}]\nvalue = {(7 * i + 3) / 9!r}\n" for i in range(ROBOTS))
    edges = [[f"r{i}", f"r{j}"] for i, j in SHAPES[shape]]
    return f'network = "lab"\n{robots}[topology]\nedges = {edges}\n[mesh]\n{key}\n{values}'.replace("'", '"')
