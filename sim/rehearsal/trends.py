"""The trend of a swarm's results: whether they settle, agree, or grow without end."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from swarm.core.arrays import is_array

SETTLED = 0.01
"""Share of the way from the first results to the last ones within which results have settled."""

ROUNDING = 1e-9
"""Share of its last value by which a result that stands still may move."""

GROWTH = 10.0
"""Factor of growth. Results that grow by it from a quarter of the run to the half, and again to the end, have no
end."""

WILD = 1e3
"""A run diverges only if results exceed this factor of the largest first result."""


def judge(histories: Mapping[str, Sequence[Mapping[str, Any]]]) -> dict[str, object]:
    """Describe the results of all robots over the iterations.

    `settles`: the iteration from which all stay near their last values (None where they still move); `spread`: the
    largest difference between two robots at the end; `grows`: whether they diverge.
    """
    rows = {name: [numbers(result.values()) for result in history] for name, history in histories.items()}
    count = min((len(row) for row in rows.values()), default=0)
    width = min((len(row[0]) for row in rows.values() if row), default=0)
    if count < 4 or width == 0:
        return {"settles": None, "spread": None, "grows": False}

    def size(k: int) -> float:
        return max(abs(value) for row in rows.values() for value in row[k])

    half, quarter = size((count - 1) // 2), size((count - 1) // 4)
    grows = size(count - 1) > GROWTH * half > GROWTH**2 * quarter and size(count - 1) > WILD * (size(0) + 1e-9)
    spread = max(
        max(row[count - 1][i] for row in rows.values()) - min(row[count - 1][i] for row in rows.values())
        for i in range(width)
    )
    return {"settles": None if grows else _settles(rows, count, width), "spread": spread, "grows": grows}


def _settles(rows: Mapping[str, Sequence[Sequence[float]]], count: int, width: int) -> int | None:
    last = 0
    for row in rows.values():
        for i in range(width):
            end = row[count - 1][i]
            way = max(abs(values[i] - end) for values in row[:count])
            near = SETTLED * way + ROUNDING * abs(end)
            moving = [k for k in range(count) if abs(row[k][i] - end) > near]
            last = max(last, max(moving, default=-1) + 1)
    # Near its own last value everything is at the very end; what settles does so with time to spare.
    return last if last <= 0.9 * (count - 1) else None


def numbers(values: Iterable[object]) -> list[float]:
    """Return the numbers among values, those of vectors one by one."""
    found: list[float] = []
    for value in values:
        if isinstance(value, int | float):
            found.append(float(value))
        elif isinstance(value, tuple | list):
            found += numbers(value)
        elif is_array(value):
            found += value.ravel().tolist()  # type: ignore[attr-defined]
    return found
