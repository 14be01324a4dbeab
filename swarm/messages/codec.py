"""Messages as msgpack maps: typed dataclasses in, bytes out, and back with every field checked.

A decoder is compiled once for each type, so that checking costs a few microseconds and a missing or wrong field is
refused at the edge with an error that names key and field. A field that the type does not have is refused in a command
and ignored in telemetry, which a robot with another release may have sent (docs/reference/keys.md).
"""

import contextlib
import dataclasses
import enum
import math
import types
import typing
from collections.abc import Callable, Iterable, Mapping
from functools import cache
from typing import Annotated, Any, TypeVar

import msgpack

from swarm.errors import LONGEST_SHOWN, LocalError, PayloadError, cut, shown
from swarm.frozen import frozen

MAX_PAYLOAD = 64 * 1024
"""Largest payload of a message on the bus, in bytes. Files are sent in other ways."""

MAX_BINARY = 960 * 1024
"""Largest payload of raw bytes that the bus carries: what one app sends to another. Files go by other ways. A larger
one would not fit Zenoh's queue, 16 batches of 64 KiB, and be dropped silently."""

MAX_REQUEST = MAX_BINARY + 4096
"""Largest request that carries such a payload: ticket, names and numbers come on top."""

Value = float | int | bool | str | tuple[float, ...]
"""A value of a free-form map on the bus, such as an app's state."""

MAX_COUNT = (1 << 63) - 1
"""The greatest value of a number that is counted up by one and reported to others, such as the starts of a process."""

T = TypeVar("T")
_Check = Callable[[object, str], Any]

_ARRAY16, _ARRAY32 = b"\xdc", b"\xdd"

_TELEMETRY: set[type] = set()
"""Message types of which unknown fields are ignored."""


def with_telemetry(topics: dict[tuple[str, str], type]) -> dict[tuple[str, str], type]:
    """Note the types that are telemetry among the message types by (service, topic), and return the same topics: all
    types but those of commands, which travel under a topic with the chunk `set`. A type that is both is telemetry."""
    _TELEMETRY.update(kind for (_, topic), kind in topics.items() if "set" not in topic.split("/"))
    return topics


@frozen
class Letters:
    """The most letters of a text, in the type of a message's field: see `Short`."""

    most: int


Short = Annotated[str, Letters(64)]
"""A text that an answer or a log repeats, such as a name or a ticket: one without a bound would make the answer larger
than the bus takes."""


@frozen
class Between:
    """The range of a whole number, in the type of a message's field: `Annotated[int, Between(0, 9)]` takes 0 to 9."""

    low: int
    high: int


@frozen
class Within:
    """The greatest magnitude of a number, in the type of a message's field, see `Measured`."""

    most: float


Measured = Annotated[float, Within(1e7)]
"""A length in m, an angle in rad or an age in s. Its bound is above any real one, also above that of a path of days."""


def encode(message: object) -> bytes:
    """Pack a message dataclass into a msgpack map of its fields, nested dataclasses too."""
    try:
        data: bytes = msgpack.packb(message, default=_plain)
    except (TypeError, ValueError, OverflowError) as error:
        raise LocalError(f"{type(message).__name__}: {error}") from None
    if len(data) > (limit := limit_of(type(message))):
        raise LocalError(f"{type(message).__name__}: {len(data)} bytes, the bus takes at most {limit}")
    return data


def decode(kind: type[T], payload: bytes, key: str) -> T:
    """Unpack `payload` into the dataclass `kind`; `PayloadError` names `key` and the field at fault."""
    try:
        check = _checker(typing.cast(Any, kind), kind not in _TELEMETRY)
        return typing.cast(T, check(unpack(payload, limit_of(kind)), ""))
    except PayloadError as error:
        raise PayloadError(f"{key}: {error}") from None


def decode_any(kinds: Iterable[type[T]], payload: bytes, key: str) -> T | None:
    """Unpack `payload` into the first dataclass of `kinds` that fits it; None where none does."""
    for kind in kinds:
        with contextlib.suppress(PayloadError):
            return decode(kind, payload, key)
    return None


def decoded(
    kind: type[T], take: Callable[[T], None], refused: Callable[[PayloadError], None] = lambda error: None
) -> Callable[[str, bytes], None]:
    """Return the callback of a subscription that calls `take(message)` for each sample which is a message of type
    `kind`, and `refused(error)` for every other one."""

    def handle(key: str, payload: bytes) -> None:
        try:
            message = decode(kind, payload, key)
        except PayloadError as error:
            refused(error)
        else:
            take(message)

    return handle


def as_value(value: object) -> Value:
    """Convert an author's value into one that a free-form map carries: lists to tuples of floats; numpy arrays, and
    lists of lists of one length, row by row; members of an enum by name. Raises `LocalError` for other values."""
    if type(value) is float and math.isfinite(value):
        return value
    if isinstance(value, enum.Enum):
        return value.name
    if isinstance(value, bool | str):
        return value
    if isinstance(value, int) and -(1 << 63) <= value < 1 << 63:
        return int(value)
    if isinstance(value, float) and math.isfinite(value):
        return float(value)
    if isinstance(value, tuple | list):
        if not all(map(_is_number, value)):
            value = _plain_items(value)
            if all(isinstance(row, tuple | list) for row in value) and len({*map(len, value)}) == 1:
                value = _plain_items([x for row in value for x in row])
        if all(map(_is_number, value)):
            return tuple([float(x) for x in value])
    elif type(value).__module__ == "numpy" and hasattr(value, "tolist"):
        return as_value(value.ravel().tolist() if value.shape else value.item())  # type: ignore[attr-defined]
    raise LocalError(f"expected a finite number, bool, text or vector, got {shown(value)}")


def limit_of(kind: type) -> int:
    """Return the number of bytes that a packed message of a type may have: its `LIMIT`, for those that carry what apps
    send, or the usual bound."""
    limit: int = getattr(kind, "LIMIT", MAX_PAYLOAD)
    return limit


def unpack(payload: bytes, limit: int = MAX_PAYLOAD) -> Any:
    """Unpack any msgpack payload with limits; raises `PayloadError` (without a key) where it is none."""
    if len(payload) > limit:
        raise PayloadError(f"payload of {len(payload)} bytes, at most {limit} are accepted")
    try:
        if _ARRAY16 in payload or _ARRAY32 in payload:
            # msgpack makes a list as long as its header says before it looks at what follows, at each level anew. Where
            # the whole message is there, no header is longer than what follows it.
            whole = msgpack.Unpacker(max_buffer_size=len(payload))
            whole.feed(payload)
            whole.skip()
        return msgpack.unpackb(payload, strict_map_key=True)
    except (ValueError, TypeError, OverflowError, msgpack.UnpackException) as error:
        raise PayloadError(f"payload is not msgpack: {str(error) or type(error).__name__}") from None


def _plain(value: object) -> dict[str, object]:
    """Convert a value that msgpack does not know. msgpack calls this again for nested values."""
    kind = type(value)
    if dataclasses.is_dataclass(kind):
        return {name: getattr(value, name) for name in names_of(kind)}
    if isinstance(value, Mapping):
        return dict(value)
    raise TypeError(f"cannot carry a {kind.__name__}")


@cache
def names_of(kind: type) -> tuple[str, ...]:
    """Return the names of a dataclass' fields."""
    return tuple(field.name for field in dataclasses.fields(kind))


@cache
def _checker(kind: Any, strict: bool) -> _Check:
    """Compile the check of one type: a function of (value, path) that returns the value or raises. With `strict` a
    field that the type does not have raises, else it is left out."""
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin in (typing.Union, types.UnionType):
        return _check_union(kind, strict)
    if origin is Annotated:
        (bounds,) = kind.__metadata__
        if isinstance(bounds, Within):
            return _check_magnitude(bounds)
        return _check_length(bounds) if isinstance(bounds, Letters) else _check_range(bounds)
    if origin is tuple and arguments[1:] == (...,):
        return _check_tuple(_checker(arguments[0], strict))
    if origin is tuple:
        return _check_places([_checker(each, strict) for each in arguments])
    if origin is dict and arguments[0] is str:
        return _check_dict(_checker(arguments[1], strict))
    if dataclasses.is_dataclass(kind):
        return _check_dataclass(typing.cast(type, kind), strict)
    if kind in _PLAIN:
        return _PLAIN[kind]
    raise LocalError(f"messages cannot hold {kind}")


def wrong(value: object, path: str, wanted: str) -> PayloadError:
    """Return the error that names a wrong value by its path in a message, and what was expected there."""
    # A map or list is only named: it may be nested deeper than repr can follow.
    got = "a map" if isinstance(value, dict) else "a list" if isinstance(value, list) else shown(value)
    return PayloadError(f"{path or 'payload'}: expected {wanted}, got {got}")


def _plain_items(values: Iterable[Any]) -> list[Any]:
    """Return the items of a list, those of numpy as Python's own numbers and lists."""
    return [x.tolist() if type(x).__module__ == "numpy" else x for x in values]


def _is_number(value: object) -> bool:
    """Return whether a value is a finite number in the range of a float."""
    try:
        return isinstance(value, float | int) and math.isfinite(value)
    except OverflowError:
        return False


def _check_float(value: object, path: str) -> float:
    if type(value) is float or type(value) is int:
        try:
            number = float(value)
        except OverflowError:
            raise wrong(value, path, "a number in the range of a float") from None
        if math.isfinite(number):
            return number
    raise wrong(value, path, "a finite number")


def _check_range(bounds: Between) -> _Check:
    def check(value: object, path: str) -> int:
        if type(value) is int and bounds.low <= value <= bounds.high:
            return value
        raise wrong(value, path, f"an integer from {bounds.low} to {bounds.high}")

    return check


def _check_magnitude(bounds: Within) -> _Check:
    def check(value: object, path: str) -> float:
        number = _check_float(value, path)
        if abs(number) <= bounds.most:
            return number
        raise wrong(value, path, f"a number up to {bounds.most:g}")

    return check


def _check_length(bounds: Letters) -> _Check:
    def check(value: object, path: str) -> str:
        if type(value) is str and len(value) <= bounds.most:
            return value
        raise wrong(value, path, f"a text of at most {bounds.most} letters")

    return check


def _check_type(kind: type, expected: str) -> _Check:
    def check(value: object, path: str) -> object:
        if type(value) is kind:
            return value
        raise wrong(value, path, expected)

    return check


def _check_none(value: object, path: str) -> None:
    if value is not None:
        raise wrong(value, path, "nil")


_PLAIN: dict[object, _Check] = {
    float: _check_float,
    int: _check_type(int, "an integer"),
    bool: _check_type(bool, "true or false"),
    str: _check_type(str, "a text"),
    bytes: _check_type(bytes, "bytes"),
    type(None): _check_none,
}


def _check_union(kind: Any, strict: bool) -> _Check:
    """Return the check of a union. The type that msgpack unpacked decides which option is meant, so an int stays an
    int beside a float."""
    options: dict[type, _Check] = {}
    for option in typing.get_args(kind):
        plain = typing.get_args(option)[0] if typing.get_origin(option) is Annotated else option
        wire = _WIRE.get(typing.get_origin(plain) or plain, dict)
        if wire in options:
            raise LocalError(f"messages cannot tell the options of {kind} apart")
        options[wire] = _checker(option, strict)
    if float in options:
        options.setdefault(int, options[float])

    def check(value: object, path: str) -> Any:
        option = options.get(type(value))
        if option is None:
            raise wrong(value, path, str(kind))
        return option(value, path)

    return check


_WIRE: dict[object, type] = {**{kind: kind for kind in (float, int, bool, str, bytes, type(None))}, tuple: list}
"""The type that msgpack unpacks each option of a union to; all others are maps."""


def _check_tuple(item: _Check) -> _Check:
    def check(value: object, path: str) -> tuple[Any, ...]:
        if not isinstance(value, list):
            raise wrong(value, path, "a list")
        # Of a list: Python begins a tuple of unknown length with 10 places and cuts it, so that each one made of a
        # generator adds a block to the free list of its length, up to 2000 of every length.
        return tuple([item(entry, f"{path}[{index}]") for index, entry in enumerate(value)])

    return check


def _check_places(items: list[_Check]) -> _Check:
    """Return the check of a tuple with a fixed number of entries."""

    def check(value: object, path: str) -> tuple[Any, ...]:
        if not isinstance(value, list) or len(value) != len(items):
            raise wrong(value, path, f"a list of {len(items)}")
        return tuple(
            [item(entry, f"{path}[{index}]") for index, (item, entry) in enumerate(zip(items, value, strict=True))]
        )

    return check


def _check_dict(item: _Check) -> _Check:
    text = _PLAIN[str]

    def check(value: object, path: str) -> dict[str, Any]:
        if not isinstance(value, dict):
            raise wrong(value, path, "a map")
        return {text(name, path): item(entry, f"{path}.{name}") for name, entry in value.items()}

    return check


def _plain_types(kind: Any) -> frozenset[type]:
    """Types of which a field takes every value as it was unpacked, but for numbers that are not finite."""
    options = typing.get_args(kind) if typing.get_origin(kind) in (typing.Union, types.UnionType) else (kind,)
    return frozenset(option for option in options if option in _PLAIN)


def _check_dataclass(kind: type, strict: bool) -> _Check:
    hints = typing.get_type_hints(kind, include_extras=True)
    fields = {field.name: _checker(hints[field.name], strict) for field in dataclasses.fields(kind)}
    plain = {name: _plain_types(hints[name]) for name in fields}
    required = {
        field.name
        for field in dataclasses.fields(kind)
        if field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING
    }

    def check(value: object, path: str) -> Any:
        if not isinstance(value, dict):
            raise wrong(value, path, f"a map of {kind.__name__}")
        prefix = f"{path}." if path else ""
        if value.keys() != fields.keys():
            if missing := required - value.keys():
                raise PayloadError(f"{prefix}{min(missing)}: missing")
            unknown = value.keys() - fields.keys()
            if unknown and strict:
                name = cut(min(str(name) for name in unknown), LONGEST_SHOWN)
                raise PayloadError(f"{prefix}{name}: unknown field, {kind.__name__} has {', '.join(fields)}")
            value = {name: entry for name, entry in value.items() if name in fields}
        checked = {}
        for name, entry in value.items():
            # Nearly all fields end here: calling the check of each would take twice as long.
            if type(entry) in plain[name] and (type(entry) is not float or math.isfinite(entry)):
                checked[name] = entry
            else:
                checked[name] = fields[name](entry, prefix + name)
        return kind(**checked)

    return check
