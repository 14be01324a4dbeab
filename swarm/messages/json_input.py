"""JSON that comes from elsewhere: from a page, a robot's program behind ssh, a file that a robot has written.

Python's own reader takes more than the standard allows and fails in ways that a caller does not expect: brackets
nested 4000 deep end in a RecursionError, 1e999 and NaN are no numbers that could be written again, a number of 400
digits fits no float, half a surrogate pair cannot be encoded. All of that is refused here, with one error.
"""

import json
import math
from typing import Any

from swarm.errors import PayloadError

MAX_DEPTH = 32
"""Levels of nesting. Our deepest documents (`swarm doctor`, the page's steps) have eight."""

_INTEGERS = range(-(1 << 63), 1 << 64)
"""Integers that msgpack can carry, too."""


def read_json(text: str | bytes) -> Any:
    """Return the value of a JSON text: its numbers are finite and have at most 64 bits, its texts can be encoded.

    Raises `PayloadError`.
    """
    try:
        value = json.loads(text)
    except RecursionError:
        raise PayloadError("no JSON: nested too deep") from None
    except ValueError as error:
        raise PayloadError(f"no JSON: {error}") from None
    _check(value)
    return value


def _check(value: object) -> None:
    """Raise `PayloadError` for what other programs could not read or write again. It needs no recursion."""
    level: list[object] = [value]
    for _ in range(MAX_DEPTH):
        inner: list[object] = []
        for each in level:
            if isinstance(each, dict):
                inner += each
                inner += each.values()
            elif isinstance(each, list):
                inner += each
            elif isinstance(each, str):
                _check_text(each)
            elif isinstance(each, float) and not math.isfinite(each):
                raise PayloadError("no JSON: a number is not finite")
            elif isinstance(each, int) and each not in _INTEGERS:
                raise PayloadError("no JSON: an integer has more than 64 bits")
        if not inner:
            return
        level = inner
    raise PayloadError("no JSON: nested too deep")


def _check_text(text: str) -> None:
    try:
        text.encode()
    except UnicodeEncodeError:
        raise PayloadError("no JSON: a text has half a surrogate pair") from None
