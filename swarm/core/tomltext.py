"""The text of a TOML document: what `tomllib` reads as the very same document. A robot has no package for it."""

import json
import math
import re
from collections.abc import Mapping, Sequence

from swarm.errors import LocalError

_BARE = re.compile(r"[A-Za-z0-9_-]+")


def dump(document: Mapping[str, object]) -> str:
    """TOML text of tables, lists, texts, numbers and truth values; raises `LocalError` for anything else.

    What has no table of its own stands first, as the format demands; lists of tables become `[[name]]`.
    """
    return "\n".join(_table((), document)).lstrip("\n") + "\n"


def _table(path: tuple[str, ...], table: Mapping[str, object]) -> list[str]:
    lines = [f"{_key(name)} = {_value(value)}" for name, value in table.items() if not _has_header(value)]
    for name, value in table.items():
        inner = (*path, name)
        if isinstance(value, Mapping):
            # An empty one is there, too; one that has nothing but tables is told by them.
            own = not value or any(not _has_header(entry) for entry in value.values())
            lines += ["", f"[{_dotted(inner)}]"] * own + _table(inner, value)
        elif _has_header(value):
            assert isinstance(value, Sequence)
            for entry in value:
                lines += ["", f"[[{_dotted(inner)}]]", *_table(inner, entry)]
    return lines


def _has_header(value: object) -> bool:
    """Whether it is written as a table, or as tables, and not in one line."""
    if isinstance(value, list | tuple):
        return bool(value) and all(isinstance(entry, Mapping) for entry in value)
    return isinstance(value, Mapping)


def _value(value: object) -> str:
    match value:
        case bool():
            return "true" if value else "false"
        case int():
            return str(value)
        case float():
            return repr(value) if math.isfinite(value) else str(value)
        case str():
            return _text(value)
        case list() | tuple():
            return f"[{', '.join(map(_value, value))}]"
        case Mapping():  # in a list, with others that are no tables
            return f"{{{', '.join(f'{_key(name)} = {_value(entry)}' for name, entry in value.items())}}}"
    raise LocalError(f"TOML has no {type(value).__name__}: {value!r}")


def _text(text: str) -> str:
    """A basic string: JSON's, but that TOML also escapes DEL and knows no surrogates."""
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")


def _key(name: str) -> str:
    return name if _BARE.fullmatch(name) else _text(name)


def _dotted(path: tuple[str, ...]) -> str:
    return ".".join(map(_key, path))
