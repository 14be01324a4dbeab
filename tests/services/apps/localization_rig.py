"""What the tests of localization measure with: the thesis' table, noise, recordings."""

import csv
import math
import os
import random
from collections.abc import Callable
from pathlib import Path

import pytest
from memory_swarm import PLACES, TARGET, MemorySwarm

from swarm.messages import Measurement

Point = tuple[float, float]

RECORDINGS = Path(os.environ.get("SWARM_THESIS_DATA") or Path(__file__).parents[4] / "shared" / "thesis-data")


def exact(name: str, k: int) -> Measurement:
    place = PLACES[int(name[1:])]
    return Measurement(0.0, k, math.dist(place, TARGET), *place)


def noisy(name: str, k: int) -> Measurement:
    numbers = random.Random(f"{name} {k}")
    place = PLACES[int(name[1:])]
    x, y = (c + numbers.gauss(0, 0.035) for c in place)
    return Measurement(0.0, k, math.dist(place, TARGET) + numbers.gauss(0, 0.04), x, y)


def recorded(test: str) -> dict[str, list[list[float]]]:
    """The lines of new states (flag 0) of each robot; the columns are in thesis-data/README.md."""
    folder = RECORDINGS / "localization" / test
    if not folder.is_dir():
        pytest.skip(f"{folder}: no thesis recordings here (SWARM_THESIS_DATA names their folder)")
    rows = {}
    for index in range(3):
        with (folder / f"{index}.csv").open() as file:
            lines = [[float(cell) for cell in line] for line in csv.reader(file)]
        rows[f"r{index}"] = [line for line in lines if len(line) == 12 and line[7] == 0]
    return rows


def measured(row: list[float]) -> Measurement:
    return Measurement(0.0, 0, row[9] / 100, row[10] / 100, row[11] / 100)


def rounds_to_own_limit(swarm: MemorySwarm) -> int:
    """Rounds until all robots stay within 1 cm of their last estimates."""
    return rounds_where(swarm, lambda name: place(swarm, name, -1), 0.01)


def rounds_where(swarm: MemorySwarm, limit: Callable[[str], Point], within: float) -> int:
    names, count = list(swarm.results), len(swarm.results["r0"])
    worst = [max(math.dist(place(swarm, name, k), limit(name)) for name in names) for k in range(count)]
    return max((k for k, error in enumerate(worst) if error >= within), default=-1) + 1


def place(swarm: MemorySwarm, name: str, k: int) -> Point:
    return swarm.results[name][k]["x"], swarm.results[name][k]["y"]


def rounds_to(swarm: MemorySwarm, target: Point, within: float = 0.01) -> int:
    """Rounds until all robots stay within `within` m of `target`."""
    return rounds_where(swarm, lambda name: target, within)
