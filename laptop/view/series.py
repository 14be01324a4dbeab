"""Numbers of one key over time, for the charts of a page: of all robots at once, and no more of them than a chart has
room for."""

from collections.abc import Iterable, Sequence
from typing import Any

from swarm.errors import LocalError
from swarm.messages.json_values import is_number

MOST = 600
"""The most points of one robot in a chart."""

MOST_IN_ALL = 24_000
"""The most points of all robots together. A chart of hundreds of robots has bands, not lines."""

LARGEST = 1e300
"""Numbers of this size are left out: the page computes with differences of numbers, which must be finite."""

MAX_FIELDS = 8
MAX_DEPTH = 6

Path = tuple[str, ...]
Row = list[float | int | None]


def most_of(robots: int) -> int:
    """Return how many points each of `robots` robots may have."""
    return max(20, min(MOST, MOST_IN_ALL // max(1, robots)))


def wanted(asked: Any) -> tuple[str, list[Path]]:
    """Return topic and paths of fields of `{topic, fields: [[NAME, ...], ...]}`. Raises `LocalError`, `KeyError` or
    `TypeError`."""
    fields = [tuple(map(str, path)) for path in asked["fields"]]
    if not fields or len(fields) > MAX_FIELDS or any(not 0 < len(path) <= MAX_DEPTH for path in fields):
        raise LocalError(f"series: expected 1 to {MAX_FIELDS} fields, each of 1 to {MAX_DEPTH} names")
    return str(asked["topic"]), fields


def rows(samples: Iterable[tuple[float, object]], fields: Sequence[Path]) -> list[Row]:
    """Return `[t, k, NUMBER, ...]` for each sample that has at least one of the fields as a number. None stands for a
    field that is no number. `k` is the iteration of the sample."""
    found = []
    for t, value in samples:
        numbers = [_number(dig(value, path)) for path in fields]
        if any(number is not None for number in numbers):
            found.append([t, _number(dig(value, ("k",))), *numbers])
    return found


def dig(value: object, path: Path) -> object:
    """Return the field of a value at a path of names; None where there is none. Parts of a list are called by their
    `peer`, `anchor` or `robot`, else by their index."""
    for name in path:
        if isinstance(value, dict):
            value = value.get(name)
        elif isinstance(value, list | tuple):
            value = next((each for each in value if _called(each) == name), _at(value, name))
        else:
            return None
    return value


def _called(item: object) -> object:
    if not isinstance(item, dict):
        return None
    return next((item[name] for name in ("peer", "anchor", "robot") if item.get(name) is not None), None)


def _at(items: Sequence[object], name: str) -> object:
    return items[int(name)] if name.isascii() and name.isdigit() and int(name) < len(items) else None


def _number(value: object) -> float | int | None:
    """Return a number that a chart can draw, of a truth value 0 or 1; else None."""
    if isinstance(value, bool):
        return int(value)
    return value if is_number(value) and abs(value) < LARGEST else None
