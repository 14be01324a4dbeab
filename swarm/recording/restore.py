"""The message that a robot had published, from its record: fields that were None are there again, and those added
for Foxglove are gone."""

import dataclasses
import types
import typing
from collections.abc import Mapping
from functools import cache
from typing import Any

from swarm.errors import PayloadError
from swarm.messages import type_of


def published(topic: str, message: Mapping[str, Any]) -> dict[str, Any]:
    """Return the message's fields as they were on the bus. Of topics that only recordings have, the message as it
    is."""
    try:
        kind = type_of(topic)
    except PayloadError:
        kind = None
    return dict(message) if kind is None else _restored(kind, message)


def _restored(kind: Any, value: Any) -> Any:
    if isinstance(value, Mapping) and isinstance(kind, type) and dataclasses.is_dataclass(kind):
        return {name: _restored(inner, value.get(name)) for name, inner in _fields(kind).items()}
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin in (typing.Union, types.UnionType) and value is not None:
        return _restored(next(argument for argument in arguments if argument is not types.NoneType), value)
    if origin is tuple and isinstance(value, tuple):
        return [_restored(arguments[0], entry) for entry in value]
    return value


@cache
def _fields(kind: Any) -> dict[str, Any]:
    hints = typing.get_type_hints(kind)
    return {field.name: hints[field.name] for field in dataclasses.fields(kind)}
