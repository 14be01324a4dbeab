"""The measurement errors of the thesis' own simulations of localization (4.3.3, figure 4.9), as recordings to replay.

"A 5 % random error to agent positions and distances (accuracy bias), and a 2 % periodic noise every 5 iterations
(precision bias)": each coordinate of a robot's place and its range to the target are multiplied by 1 + u, u uniform
within +-5 % and drawn once for the run, then by 1 + v, v uniform within +-2 % and drawn anew every five iterations. A
place's error so grows with its distance to the corner of the table, where the thesis has its origin.
"""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Protocol

from swarm.recordings import Recording, Row

ERRORS = {"none": (0.0, 0.0), "bias": (0.05, 0.0), "thesis": (0.05, 0.02)}
"""By name: share of the bias, share of the noise. Figure 4.9 (a) and (b), (c), (d)."""

EVERY = 5
"""Iterations that one draw of the noise holds."""

ITERATION = 0.32
"""s; what the thesis' iterations took in its five localization runs."""

Point = tuple[float, float]


class Generator(Protocol):
    """The part of `random.Random` that is used here."""

    def uniform(self, a: float, b: float) -> float: ...  # noqa: D102


def recording(model: str, robot: str, place: Point, target: Point, rows: int, numbers: Generator) -> Recording:
    """What a robot at `place` measures in `rows` iterations, m."""
    bias, noise = ERRORS[model]
    true = (math.dist(place, target), *place)
    biased = [value * (1.0 + numbers.uniform(-bias, bias)) for value in true]
    measured: list[Row] = []
    for k in range(rows):
        if k % EVERY == 0:
            row = Row(*(value * (1.0 + numbers.uniform(-noise, noise)) for value in biased))
        measured.append(row)
    times = tuple(ITERATION * k for k in range(rows))
    return Recording(Path(f"{robot}, noise {model}"), tuple(measured), times, ((0.0, 0.0),))


def as_csv(recording: Recording) -> str:
    """The recording in the layout of `swarm.recordings`; no estimates are known, so those columns are zero."""
    lines = ["0.0" + ",0.0" * 6]
    for t, row in zip(recording.times, recording.rows, strict=True):
        lines.append(",".join([repr(t), *["0.0"] * 6, "0", "0.0", *(repr(100.0 * value) for value in row)]))
    return "\n".join(lines) + "\n"


def scene(
    model: str, places: Mapping[str, Point], target: Point, rows: int, numbers: Generator
) -> dict[str, Recording]:
    """The recordings of all robots."""
    return {name: recording(model, name, place, target, rows, numbers) for name, place in places.items()}
