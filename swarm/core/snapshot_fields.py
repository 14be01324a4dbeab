"""An app's private fields as bytes: msgpack, for a restart."""

from collections.abc import Mapping
from functools import partial
from typing import Any

import msgpack

from swarm.core import arrays
from swarm.errors import AppError, shown

MOST_LEVELS = 32
"""Levels of tuples within tuples: each is unpacked by a call of its own, and a thread's stack has room for some 170."""

_TUPLE = 1  # msgpack extension type: Python tuples come back as tuples, not as lists
_ARRAY = 2  # numpy's arrays and single numbers: type, shape, bytes
_BYTEARRAY = 3  # msgpack itself makes bytes of it

_PLAIN = frozenset({int, float, str, bytes, bool, type(None), tuple})
"""Types in which no bytearray can hide from `_to_extension`."""


def pack_private(values: Mapping[str, object]) -> bytes:
    """Private fields as msgpack, tuples and lists kept apart; `AppError` names the field at fault."""
    if not values:
        return _NOTHING
    try:
        return _packb(dict(values))
    except (TypeError, ValueError, OverflowError, RecursionError):
        for name, value in values.items():
            try:
                _packb(value)
            except (TypeError, ValueError, OverflowError, RecursionError) as error:
                raise AppError(f"{name}: {shown(value)} cannot be saved for a restart ({error})") from None
        raise


def unpack_private(data: bytes) -> dict[str, Any]:
    """Unpack what `pack_private` has packed."""
    values: dict[str, Any] = msgpack.unpackb(data, ext_hook=_from_extension, strict_map_key=False)
    return values


def _packb(value: object, level: int = 0) -> bytes:
    data: bytes = msgpack.packb(_marked(value), default=_EXTENSIONS[level], strict_types=True)
    return data


def _marked(value: object) -> object:
    """Return a value with an extension in place of each bytearray, of which msgpack does not ask `_to_extension`."""
    if isinstance(value, bytearray):
        return msgpack.ExtType(_BYTEARRAY, bytes(value))
    if isinstance(value, memoryview):
        raise TypeError("type memoryview")  # bytes would come back
    if type(value) is list and not _PLAIN.issuperset(map(type, value)):
        return [_marked(each) for each in value]
    if type(value) is dict and not _PLAIN.issuperset(map(type, value.values())):
        return {key: _marked(each) for key, each in value.items()}
    return value


def _to_extension(level: int, value: object) -> object:
    if isinstance(value, tuple):
        if level + 1 == MOST_LEVELS:
            raise ValueError(f"tuples within tuples, more than {MOST_LEVELS} levels")
        return msgpack.ExtType(_TUPLE, _packb(list(value), level + 1))
    if arrays.is_array(value):
        return msgpack.ExtType(_ARRAY, _packb(list(arrays.pack(value))))
    raise TypeError(f"type {type(value).__name__}")


_NOTHING: bytes = msgpack.packb({})
_EXTENSIONS = tuple(partial(_to_extension, level) for level in range(MOST_LEVELS))


def _from_extension(code: int, data: bytes) -> object:
    if code == _BYTEARRAY:
        return bytearray(data)
    items = msgpack.unpackb(data, ext_hook=_from_extension, strict_map_key=False)
    if code == _ARRAY:
        return arrays.unpack(*items)
    return tuple(items) if code == _TUPLE else items
