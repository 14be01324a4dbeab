"""The measurement errors of the thesis' own simulations of localization (4.3.3, figure 4.9), as recordings to replay.

"A 5 % random error to agent positions and distances (accuracy bias), and a 2 % periodic noise every 5 iterations
(precision bias)": each coordinate of a robot's place and its range to the target are multiplied by 1 + u, u uniform
within +-5 % and drawn once for the run, then by 1 + v, v uniform within +-2 % and drawn anew every five iterations. A
place's error so grows with its distance to the corner of the table, where the thesis has its origin.
"""

import math
from collections.abc import Mapping
from pathlib import Path

from swarm.core.random_numbers import RandomNumbers
from swarm.recording.thesis_ranges import ThesisRecording, ThesisRow, cost

ERRORS = {"none": (0.0, 0.0), "bias": (0.05, 0.0), "thesis": (0.05, 0.02)}
"""Share of the bias and share of the noise, by name. Figure 4.9 (a) and (b), (c), (d)."""

EVERY = 5
"""Iterations that one draw of the noise holds."""

ITERATION = 0.32
"""Duration of an iteration in the thesis' five localization runs, s."""

Point = tuple[float, float]


def noisy_recordings(
    model: str, places: Mapping[str, Point], target: Point, rows: int, numbers: RandomNumbers
) -> dict[str, ThesisRecording]:
    """Return by name what robots at `places` measure in `rows` iterations, m. All biases are drawn first, so two
    models have the same."""
    bias, noise = ERRORS[model]
    biased = {
        name: [value * (1.0 + numbers.uniform(-bias, bias)) for value in (math.dist(place, target), *place)]
        for name, place in places.items()
    }
    times = tuple(ITERATION * k for k in range(rows))
    made = {}
    for name, values in biased.items():
        measured: list[ThesisRow] = []
        for k in range(rows):
            if k % EVERY == 0:
                row = ThesisRow(*(value * (1.0 + numbers.uniform(-noise, noise)) for value in values))
            measured.append(row)
        made[name] = ThesisRecording(Path(f"{name}, noise {model}"), tuple(measured), times, ((0.0, 0.0),))
    return made


def as_csv(recording: ThesisRecording) -> str:
    """Return the recording in the layout of `swarm.recording.thesis_ranges`; the columns of estimates are zero."""
    lines = ["0.0" + ",0.0" * 6]
    for t, row in zip(recording.times, recording.rows, strict=True):
        distance, own_x, own_y = (100.0 * value for value in row)
        cells = (cost(distance, 0.0, 0.0, own_x, own_y), distance, own_x, own_y)
        lines.append(",".join([repr(t), *["0.0"] * 6, "0", *map(repr, cells)]))
    return "\n".join(lines) + "\n"
