"""Messages as msgpack maps: typed dataclasses in, bytes out, and back with every field checked.

A decoder is compiled once for each type, so that checking costs a few microseconds and an unknown, missing or wrong
field is refused at the edge with an error that names key and field.
"""

import dataclasses
import math
import types
import typing
from collections.abc import Callable, Mapping
from functools import lru_cache
from typing import Any, TypeVar

import msgpack

from swarm.errors import LocalError, PayloadError

MAX_PAYLOAD = 64 * 1024
"""Largest payload accepted on the bus, in bytes: messages stay small, files go by other ways."""

Value = float | int | bool | str | tuple[float, ...]
"""What a free-form map on the bus (an app's state, say) may hold."""

T = TypeVar("T")
_Check = Callable[[object, str], Any]


def encode(message: object) -> bytes:
    """Pack a message dataclass into a msgpack map of its fields, nested dataclasses too."""
    data: bytes = msgpack.packb(_plain(message))
    if len(data) > MAX_PAYLOAD:
        raise LocalError(f"{type(message).__name__}: {len(data)} bytes, the bus takes at most {MAX_PAYLOAD}")
    return data


def decode(kind: type[T], payload: bytes, key: str) -> T:
    """Unpack `payload` into the dataclass `kind`; `PayloadError` names `key` and the field at fault."""
    try:
        return typing.cast(T, _checker(kind)(unpack(payload), ""))
    except PayloadError as error:
        raise PayloadError(f"{key}: {error}") from None


def unpack(payload: bytes) -> Any:
    """Unpack any msgpack payload with limits; raises `PayloadError` (without a key) where it is none."""
    if len(payload) > MAX_PAYLOAD:
        raise PayloadError(f"payload of {len(payload)} bytes, at most {MAX_PAYLOAD} are accepted")
    try:
        return msgpack.unpackb(payload, strict_map_key=True)
    except (ValueError, msgpack.UnpackException, msgpack.StackError, UnicodeDecodeError, RecursionError) as error:
        raise PayloadError(f"payload is not msgpack: {str(error) or type(error).__name__}") from None


def _plain(value: object) -> object:
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: _plain(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if isinstance(value, (tuple, list)):
        return [_plain(item) for item in value]
    if isinstance(value, Mapping):
        return {name: _plain(item) for name, item in value.items()}
    return value


@lru_cache(maxsize=None)
def _checker(kind: Any) -> _Check:
    """Compile the check of one type: a function of (value, path) that returns the checked value or raises."""
    origin = typing.get_origin(kind)
    if origin in (typing.Union, types.UnionType):
        return _check_union(tuple(_checker(option) for option in typing.get_args(kind)), str(kind))
    if origin is tuple:
        return _check_tuple(_checker(typing.get_args(kind)[0]))
    if origin is dict:
        return _check_dict(_checker(typing.get_args(kind)[1]))
    if dataclasses.is_dataclass(kind):
        return _check_dataclass(typing.cast(type, kind))
    if kind in _PLAIN:
        return _PLAIN[kind]
    raise LocalError(f"messages cannot hold {kind}")


def _wrong(value: object, path: str, wanted: str) -> PayloadError:
    shown = repr(value)
    return PayloadError(f"{path or 'payload'}: expected {wanted}, got {shown[:60]}{'...' if len(shown) > 60 else ''}")


def _check_float(value: object, path: str) -> float:
    if type(value) is float or type(value) is int:
        try:
            number = float(value)
        except OverflowError:
            raise _wrong(value, path, "a number in the range of a float") from None
        if math.isfinite(number):
            return number
    raise _wrong(value, path, "a finite number")


def _check_int(value: object, path: str) -> int:
    if type(value) is int:
        return value
    raise _wrong(value, path, "an integer")


def _check_bool(value: object, path: str) -> bool:
    if type(value) is bool:
        return value
    raise _wrong(value, path, "true or false")


def _check_str(value: object, path: str) -> str:
    if type(value) is str:
        return value
    raise _wrong(value, path, "a text")


def _check_none(value: object, path: str) -> None:
    if value is not None:
        raise _wrong(value, path, "nil")


_PLAIN: dict[object, _Check] = {
    float: _check_float,
    int: _check_int,
    bool: _check_bool,
    str: _check_str,
    type(None): _check_none,
}


def _check_union(options: tuple[_Check, ...], wanted: str) -> _Check:
    def check(value: object, path: str) -> Any:
        # An integer must stay one where both int and float are allowed: the exact type goes first.
        exact = _PLAIN.get(type(value))
        for option in sorted(options, key=lambda option: option is not exact):
            try:
                return option(value, path)
            except PayloadError:
                continue
        raise _wrong(value, path, wanted)

    return check


def _check_tuple(item: _Check) -> _Check:
    def check(value: object, path: str) -> tuple[Any, ...]:
        if not isinstance(value, list):
            raise _wrong(value, path, "a list")
        return tuple(item(entry, f"{path}[{index}]") for index, entry in enumerate(value))

    return check


def _check_dict(item: _Check) -> _Check:
    def check(value: object, path: str) -> dict[str, Any]:
        if not isinstance(value, dict):
            raise _wrong(value, path, "a map")
        return {_check_str(name, path): item(entry, f"{path}.{name}") for name, entry in value.items()}

    return check


def _check_dataclass(kind: type) -> _Check:
    hints = typing.get_type_hints(kind)
    fields = {field.name: _checker(hints[field.name]) for field in dataclasses.fields(kind)}
    required = {
        field.name
        for field in dataclasses.fields(kind)
        if field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING
    }

    def check(value: object, path: str) -> Any:
        if not isinstance(value, dict):
            raise _wrong(value, path, f"a map of {kind.__name__}")
        prefix = f"{path}." if path else ""
        if missing := required - value.keys():
            raise PayloadError(f"{prefix}{min(missing)}: missing")
        if unknown := value.keys() - fields.keys():
            name = min(map(str, unknown))
            raise PayloadError(f"{prefix}{name}: unknown field, {kind.__name__} has {', '.join(fields)}")
        return kind(**{name: fields[name](entry, prefix + name) for name, entry in value.items()})

    return check
