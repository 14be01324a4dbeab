"""The swarms of six that the lab compares with the simulation, as configurations."""

from lab.radio.remote import address

ROBOTS = 6
ITERATIONS = 40
LONG = 200
"""Iterations of a run with faults in it."""
ENDLESS = 3000
"""Iterations of a run that a test ends: two minutes at least, whatever its links do meanwhile."""

LINE = [(i, i + 1) for i in range(ROBOTS - 1)]
LOOP = [*LINE, (0, ROBOTS - 1)]
SHAPES = {
    "line": LINE,
    "loop": LOOP,
    "random": [(0, 2), (0, 3), (1, 3), (1, 4), (2, 5), (3, 4), (4, 5)],
    "full": [(i, j) for i in range(ROBOTS) for j in range(i + 1, ROBOTS)],
}


TIMES = "suspect = 3.0\ndead = 9.0\n"
"""Longer than normal: a dozen processes share one processor, and none is lost for being slow."""


def config(shape: str, key: str, extra: str = "") -> str:
    """The swarm.toml of that shape; `key` is a line of [mesh], `extra` whole tables."""
    return _config(ROBOTS, SHAPES[shape], key) + extra


def star(shape: str, key: str) -> str:
    """The same over a hub: the first robot calls all others."""
    return _config(ROBOTS, SHAPES[shape], key, links="star")


def auto(shape: str, key: str) -> str:
    """The same with the links that the mesh chooses itself, which are those of a hub."""
    return _config(ROBOTS, SHAPES[shape], key, links="auto")


def line(robots: int, key: str, extra: str = "") -> str:
    """The swarm.toml of so many in line."""
    return _config(robots, LINE[: robots - 1], key) + extra


def _config(count: int, pairs: list[tuple[int, int]], key: str, links: str = "graph") -> str:
    robots = "".join(f'[[robots]]\nname = "r{i}"\nbluetooth = "{address(i)}"\n' for i in range(count))
    values = "".join(f"[apps.consensus.robots.r{i}]\nvalue = {(7 * i + 3) / 9!r}\n" for i in range(count))
    edges = [[f"r{i}", f"r{j}"] for i, j in pairs]
    text = f'network = "lab"\n{robots}[topology]\nedges = {edges}\n[mesh]\nlinks = "{links}"\n{key}\n{TIMES}{values}'
    return text.replace("'", '"')
