"""Values as any reader of JSON takes them."""

import math
import sys
from typing import TypeGuard

DEPTH = 12
"""Levels of nesting; msgpack allows a thousand, which would end in a RecursionError."""


def is_number(value: object) -> TypeGuard[float]:
    """Return whether a value is a number that a float can hold: neither NaN nor infinite, and no truth value."""
    return (
        isinstance(value, int | float)
        and not isinstance(value, bool)
        and -sys.float_info.max <= value <= sys.float_info.max
    )


def json_value(value: object, longest: int | None = None, depth: int = 0) -> object:
    """Convert a value for `json.dumps`: bytes to hex (of the first `longest` ones), NaN and infinity to text.
    Nesting is limited in depth."""
    if isinstance(value, float):
        return value if math.isfinite(value) else str(value)
    if value is None or isinstance(value, str | int):
        return value
    if isinstance(value, dict):
        return {str(name): json_value(item, longest, depth + 1) for name, item in cut(value, depth)}
    if isinstance(value, list | tuple):
        return [json_value(item, longest, depth + 1) for _, item in cut(value, depth)]
    if isinstance(value, bytes):
        return value[:longest].hex()
    return str(value)


def cut(value: dict[object, object] | list[object] | tuple[object, ...], depth: int) -> list[tuple[object, object]]:
    """Return the entries of a map, list or tuple by name or index; dots where it is nested too deeply."""
    if depth >= DEPTH:
        return [("...", "...")] if value else []
    return list(value.items() if isinstance(value, dict) else enumerate(value))
