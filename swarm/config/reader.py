"""Reads a table of a TOML file entry by entry; a wrong entry becomes a `ConfigError` that says where and why.

    swarm.toml: [robots.2] link: expected tcp:HOST:PORT or sim:SOCKET, got 'foo'

Tables of a list ([[robots]]) are counted from 0.
"""

import math
import re
from collections.abc import Mapping, Sequence
from typing import Any, Final

from swarm.errors import LONGEST_SHOWN, ConfigError, cut

_MAX_LISTED = 12
"""Allowed names listed in a message; a swarm may have a thousand robots."""


class _Required:
    """Marks an entry without a default."""


REQUIRED: Final = _Required()


class Table:
    """One table: `known` entries are taken by type, any other is refused at once (None = any name goes)."""

    def __init__(self, file: str, name: str, data: Mapping[str, Any], known: Sequence[str] | None) -> None:
        self.file = file
        self.name = name
        self.data = data
        if known is not None:
            for key, value in data.items():
                if key not in known:
                    raise self._unknown(key, value, known)

    def error(self, key: str | None, problem: str) -> ConfigError:
        """Return the error to raise about an entry, or about the table itself."""
        table = [f"[{self.name}]"] if self.name else []
        place = " ".join(table if key is None else [*table, quoted(key)])
        return ConfigError(f"{self.file}: {place}: {problem}")

    def _unknown(self, key: str, value: object, known: Sequence[str]) -> ConfigError:
        is_list = isinstance(value, list) and value and isinstance(value[0], dict)
        if isinstance(value, dict) or is_list:
            return ConfigError(f"{self.file}: [{self._below(key)}]: unknown table; {suggest(key, known)}")
        return self.error(key, f"unknown entry; {suggest(key, known)}")

    def wrong(self, key: str, expected: str) -> ConfigError:
        """Return the error for an entry that is there but not as expected, or that is missing."""
        if key not in self.data:
            return self.error(key, f"missing; expected {expected}")
        return self.error(key, f"expected {expected}, got {shown(self.data[key])}")

    def __contains__(self, key: str) -> bool:
        return key in self.data

    def _absent(self, key: str, default: object, expected: str) -> bool:
        if key in self.data:
            return False
        if isinstance(default, _Required):
            raise self.wrong(key, expected)
        return True

    def flag(self, key: str, default: bool) -> bool:
        """Return the entry `key`, true or false."""
        value = self.data.get(key, default)
        if not isinstance(value, bool):
            raise self.wrong(key, "true or false")
        return value

    def text(
        self,
        key: str,
        default: str | _Required | None = REQUIRED,
        *,
        expected: str = "a text",
        pattern: re.Pattern[str] | None = None,
    ) -> Any:
        """Return a text of printable characters that is not empty and matches `pattern`; None only as the default."""
        if self._absent(key, default, expected):
            return default
        value = self.data[key]
        if not isinstance(value, str) or not value or not value.isprintable():
            raise self.wrong(key, expected)
        if pattern is not None and not pattern.fullmatch(value):
            raise self.wrong(key, expected)
        return value

    def choice(self, key: str, default: str, options: Sequence[str]) -> str:
        """Return the entry `key`, which must be one of `options`."""
        value = self.data.get(key, default)
        if not isinstance(value, str) or value not in options:
            raise self.wrong(key, " or ".join(options))
        return value

    def number(
        self,
        key: str,
        default: float | _Required | None = REQUIRED,
        *,
        above: float = -math.inf,
        up_to: float = math.inf,
        expected: str = "a finite number",
    ) -> Any:
        """Return a finite number x with above < x <= up_to as a float; None only as the default."""
        if self._absent(key, default, expected):
            return default
        value = finite(self.data[key])
        if value is None or not above < value <= up_to:
            raise self.wrong(key, expected)
        return value

    def count(self, key: str, default: int, *, low: int) -> int:
        """Return a whole number that is at least `low`."""
        value = self.data.get(key, default)
        if isinstance(value, bool) or not isinstance(value, int) or not low <= value < 2**31:
            raise self.wrong(key, f"a whole number, at least {low}")
        return value

    def numbers(self, key: str, default: tuple[float, ...] | _Required, *, expected: str, length: int) -> Any:
        """Return a list of `length` finite numbers as a tuple of floats."""
        if self._absent(key, default, expected):
            return default
        value = vector(self.data[key])
        if value is None or len(value) != length:
            raise self.wrong(key, expected)
        return value

    def table(self, key: str, known: Sequence[str] | None) -> "Table":
        """Return the table `key` within this one; empty where the file has none."""
        value = self.data.get(key, {})
        if not isinstance(value, dict):
            raise self.wrong(key, f"a table, written [{self._below(key)}]")
        return Table(self.file, self._below(key), value, known)

    def tables(self, key: str, known: Sequence[str]) -> list["Table"]:
        """Return a list of tables, written [[key]]; empty where the file has none."""
        value = self.data.get(key, [])
        if not isinstance(value, list) or not all(isinstance(item, dict) for item in value):
            raise self.wrong(key, f"a list of tables, each written [[{self._below(key)}]]")
        return [Table(self.file, f"{self._below(key)}.{i}", item, known) for i, item in enumerate(value)]

    def _below(self, key: str) -> str:
        return f"{self.name}.{quoted(key)}" if self.name else quoted(key)


def finite(value: object) -> float | None:
    """`value` as a float where it is a finite number (a bool is none), else None."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return None
    try:
        number = float(value)
    except OverflowError:
        return None
    return number if math.isfinite(number) else None


def vector(value: object) -> tuple[float, ...] | None:
    """`value` as a tuple of floats where it is a list of finite numbers, else None."""
    if not isinstance(value, list):
        return None
    numbers = [finite(item) for item in value]
    return tuple(item for item in numbers if item is not None) if None not in numbers else None


def suggest(word: str, known: Sequence[str]) -> str:
    """`did you mean X?` where a known word is near, else the list of them."""
    import difflib  # only a wrong file needs it

    near = difflib.get_close_matches(word, known, n=1)
    if near:
        return f"did you mean {near[0]}?"
    if len(known) < 3:
        return f"expected {' or '.join(known)}"
    return f"expected one of {listed(known)}"


def listed(names: Sequence[str]) -> str:
    """Return the names for a message, the first ones where there are many."""
    return ", ".join(names[:_MAX_LISTED]) + (", ..." if len(names) > _MAX_LISTED else "")


def quoted(key: str) -> str:
    """Return a key as TOML writes it: without quotes where that is allowed."""
    return key if re.fullmatch(r"[A-Za-z0-9_-]+", key) else shown(key)


def shown(value: object) -> str:
    """Return a wrong value as short text on one line, for a message."""
    if isinstance(value, dict):
        return "a table"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, list) and any(isinstance(item, (dict, list)) for item in value):
        return f"a list of {len(value)} lists or tables"
    if isinstance(value, int) and abs(value) >= 2**63:
        return "a number of more than 64 bits"  # repr() of a huge one raises
    if isinstance(value, list) and len(value) > LONGEST_SHOWN:
        return f"a list of {len(value)}"
    text = f"[{', '.join(map(shown, value))}]" if isinstance(value, list) else repr(value)
    return cut(text, LONGEST_SHOWN)
