"""The check that a message has values of the right types in its fields, though some may be missing or unknown.

For who shows messages: what other robots send may come from another release, or with some of its fields only
(`mesh/view`). Who acts on a message decodes it (`swarm.messages.codec`), where each field must be there.
"""

import dataclasses
import sys
import types
import typing
from collections.abc import Callable
from functools import cache
from typing import Any

from swarm.errors import PayloadError
from swarm.messages.codec import wrong

_Check = Callable[[object, str], None]


def check_fields(kind: type, value: object) -> None:
    """Check a decoded message as `swarm.messages.json_values` makes it; `PayloadError` names the first wrong field."""
    _checker(kind)(value, "")


@cache
def _checker(kind: Any) -> _Check:
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if dataclasses.is_dataclass(kind):
        return _dataclass(typing.cast(type, kind))
    if origin in (typing.Union, types.UnionType):
        return _union([_checker(option) for option in arguments])
    if origin is tuple:
        return _list(_checker(arguments[0]))
    if origin is dict:
        return _map(_checker(arguments[1]))
    return _PLAIN[kind]


def _wrong(value: object, path: str, wanted: str) -> PayloadError:
    return wrong(value, path or "message", wanted)


def _dataclass(kind: type) -> _Check:
    hints = typing.get_type_hints(kind)
    fields = {field.name: _checker(hints[field.name]) for field in dataclasses.fields(kind)}

    def check(value: object, path: str) -> None:
        if not isinstance(value, dict):
            raise _wrong(value, path, f"a map of {kind.__name__}")
        for name, entry in value.items():
            if (field := fields.get(name)) is not None:
                field(entry, f"{path}.{name}" if path else name)

    return check


def _union(options: list[_Check]) -> _Check:
    def check(value: object, path: str) -> None:
        for option in options[:-1]:
            try:
                return option(value, path)
            except PayloadError:
                continue
        return options[-1](value, path)

    return check


def _list(item: _Check) -> _Check:
    def check(value: object, path: str) -> None:
        if not isinstance(value, list):
            raise _wrong(value, path, "a list")
        for index, entry in enumerate(value):
            item(entry, f"{path}[{index}]")

    return check


def _map(item: _Check) -> _Check:
    def check(value: object, path: str) -> None:
        if not isinstance(value, dict):
            raise _wrong(value, path, "a map")
        for entry in value.values():
            item(entry, f"{path}.*")

    return check


def _of(wanted: str, test: Callable[[Any], bool]) -> _Check:
    def check(value: object, path: str) -> None:
        if not test(value):
            raise _wrong(value, path, wanted)

    return check


def _is_finite(value: Any) -> bool:
    return type(value) in (int, float) and -sys.float_info.max <= value <= sys.float_info.max


_PLAIN: dict[object, _Check] = {
    float: _of("a finite number", _is_finite),
    int: _of("an integer", lambda value: type(value) is int),
    bool: _of("true or false", lambda value: type(value) is bool),
    str: _of("a text", lambda value: type(value) is str),
    bytes: _of("bytes as a text", lambda value: type(value) is str),
    type(None): _of("nothing", lambda value: value is None),
}
