"""Messages as JSON text and their JSON schemas, for recordings.

Floats are written by repr: equal text means equal bits, and they come back to the bit. JSON has no infinities or NaN,
so these are `1e999`, `-1e999` and `null`. What is None in a message class is left out. Enumerations are written by
name.
"""

import base64
import dataclasses
import enum
import json
import math
import types
import typing
from collections.abc import Mapping
from functools import cache
from json.encoder import c_make_encoder, encode_basestring_ascii  # type: ignore[attr-defined]
from typing import Any

from swarm.errors import LocalError
from swarm.messages.codec import names_of

Json = dict[str, Any]


def encode(message: object) -> bytes:
    """Encode a dataclass or mapping as JSON text. Raises `LocalError` for other values."""
    try:
        return "".join(_pieces(message, 0)).encode()
    except ValueError:  # not finite, most likely
        try:
            return _text(message).encode()
        except (TypeError, ValueError, RecursionError) as error:
            raise LocalError(f"cannot be recorded: {error}") from None
    except (TypeError, RecursionError) as error:
        raise LocalError(f"cannot be recorded: {error}") from None


def decode(data: bytes) -> Any:
    """Decode what `encode` was given, in plain types: lists are tuples."""
    found = decode_lists(data)
    return _tupled(found) if b"[" in data else found


def decode_lists(data: bytes) -> Any:
    """Decode what `encode` was given, in JSON's types."""
    return json.loads(data.decode("utf-8", "surrogatepass"))


def schema(message: object, name: str) -> bytes:
    """Return the JSON schema of messages like this one, packed. Free-form maps in it get the fields that they have now,
    and a field of several types the type that it has now."""
    shape = _of_value(message)
    return json.dumps({"title": name, **shape}, separators=(",", ":")).encode()


def schema_of(kind: type, fields: Mapping[str, object], name: str) -> bytes:
    """Return the JSON schema of messages of a class, packed, made from a message that came as a map of its fields."""
    return json.dumps({"title": name, **_of_fields(kind, fields)}, separators=(",", ":")).encode()


def _plain(value: object) -> object:
    """Convert a value that JSON does not know."""
    if dataclasses.is_dataclass(value):
        return {name: entry for name in names_of(value.__class__) if (entry := getattr(value, name)) is not None}
    if isinstance(value, enum.Enum):
        return value.name
    if isinstance(value, Mapping):
        return dict(value)
    if isinstance(value, bytes | bytearray | memoryview):
        return base64.b64encode(value).decode()
    raise TypeError(f"a {type(value).__name__} has no form in JSON")


_pieces = c_make_encoder(None, _plain, encode_basestring_ascii, None, ":", ",", False, False, False)
"""What `json.JSONEncoder(allow_nan=False, separators=(",", ":"), default=_plain)` makes each time; that takes
longer than a small message."""


def _text(value: object) -> str:
    """Encode a value as JSON text, with numbers that are not finite."""
    if isinstance(value, float):
        if math.isnan(value):
            return "null"
        return float.__repr__(value) if math.isfinite(value) else "1e999" if value > 0 else "-1e999"
    if isinstance(value, Mapping):
        return "{" + ",".join(f"{json.dumps(str(key))}:{_text(entry)}" for key, entry in value.items()) + "}"
    if isinstance(value, list | tuple):
        return "[" + ",".join(map(_text, value)) + "]"
    if value is None or isinstance(value, str | int):
        return json.dumps(value)
    return _text(_plain(value))


def _tupled(value: Any) -> Any:
    if isinstance(value, list):
        return tuple(map(_tupled, value))
    if isinstance(value, dict):
        return {key: _tupled(entry) for key, entry in value.items()}
    return value


def _of_value(value: object) -> Json:
    """Return the schema of one value as it stands."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return _of_fields(type(value), {name: getattr(value, name) for name in names_of(type(value))})
    if isinstance(value, Mapping):
        return {"type": "object", "properties": {str(name): _of_value(entry) for name, entry in value.items()}}
    if isinstance(value, list | tuple):
        return {"type": "array", "items": _of_value(value[0]) if value else {"type": "number"}}
    if isinstance(value, bytes | bytearray | memoryview):
        return dict(_BYTES)
    for kind, name in ((bool, "boolean"), (int, "integer"), (float, "number")):
        if isinstance(value, kind):
            return {"type": name}
    return {"type": "number"} if value is None else {"type": "string"}


def _of_fields(kind: type, fields: Mapping[str, object]) -> Json:
    """Return the schema of a message class; free-form maps, and fields of several types, as they stand in `fields`."""
    shape, hints = _of_type(kind), _hints(kind)
    free = {
        name: _of_value(fields[name])
        for name, field in shape["properties"].items()
        if name in fields and (field == _FREE or len(_kinds(hints[name])) > 1)
    }
    return {**shape, "properties": shape["properties"] | free}


_FREE: Json = {"type": "object", "properties": {}}
_BYTES = {"type": "string", "contentEncoding": "base64"}


_hints = cache(typing.get_type_hints)


@cache
def _of_type(kind: Any) -> Json:
    """Return the schema of a message class, or of the type of one of its fields. What may be None may be missing."""
    if dataclasses.is_dataclass(kind):
        hints = _hints(typing.cast(type, kind))
        return {
            "type": "object",
            "properties": {name: _of_type(hints[name]) for name in names_of(typing.cast(type, kind))},
        }
    if kind in _PLAIN:
        return dict(_PLAIN[kind])
    if kinds := _kinds(kind):
        return _of_type(kinds[0])
    if typing.get_origin(kind) is tuple:
        return {"type": "array", "items": _of_type(typing.get_args(kind)[0])}
    return _FREE


def _kinds(kind: Any) -> list[Any]:
    """Return the types of a union but for None; none of a type that is no union."""
    if typing.get_origin(kind) not in (typing.Union, types.UnionType):
        return []
    return [argument for argument in typing.get_args(kind) if argument is not type(None)]


_PLAIN: dict[object, Json] = {
    float: {"type": "number"},
    int: {"type": "integer"},
    bool: {"type": "boolean"},
    str: {"type": "string"},
    bytes: _BYTES,
}
