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

    `settles`: the iteration from which all stay near their last values (None where they still move), and `slowest`: the
    name of the result that moves last; `spread`: the largest difference between two robots at the end, and `widest`:
    the name of the result that has it (no names without results); `grows`: whether they diverge.
    """
    rows = {name: [numbers(result.values()) for result in history] for name, history in histories.items()}
    count = min((len(row) for row in rows.values()), default=0)
    width = min((len(row[0]) for row in rows.values() if row), default=0)
    if count < 4 or width == 0:
        return {"settles": None, "spread": None, "grows": False}
    names = [name for name, value in next(iter(histories.values()))[0].items() for _ in numbers([value])]

    def size(k: int) -> float:
        return max(abs(value) for row in rows.values() for value in row[k])

    half, quarter = size((count - 1) // 2), size((count - 1) // 4)
    grows = size(count - 1) > GROWTH * half > GROWTH**2 * quarter and size(count - 1) > WILD * (size(0) + 1e-9)
    settled = [[_settles(row, i) for i in range(width)] for row in rows.values()]
    lasts = list(map(max, zip(*settled, strict=True)))
    ends = [[row[-1][i] for row in rows.values()] for i in range(width)]
    spreads = [max(values) - min(values) for values in ends]
    # Near its own last value everything is at the very end; what settles does so with time to spare.
    in_time = not grows and all(
        max(own) <= 0.9 * (len(row) - 1) for own, row in zip(settled, rows.values(), strict=True)
    )
    return {
        "settles": max(lasts) if in_time else None,
        "slowest": names[lasts.index(max(lasts))],
        "spread": max(spreads),
        "widest": names[spreads.index(max(spreads))],
        "grows": grows,
    }


def _settles(row: Sequence[Sequence[float]], i: int) -> int:
    """Return the iteration from which number i of a robot stays near its last value."""
    end = row[-1][i]
    near = SETTLED * max(abs(values[i] - end) for values in row) + ROUNDING * abs(end)
    return max((k + 1 for k, values in enumerate(row) if abs(values[i] - end) > near), default=0)


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
