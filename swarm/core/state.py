"""An app's shared state as bytes: fields at fixed width, for the air.

Shared fields are packed little endian, without padding, in declared order (base classes first): float as float64,
float32, int as int64, bool as one byte, an enum.Enum as the number of its member (one byte), `Annotated[Vector, n]` as
n float64, `Annotated[Matrix, n, m]` as n rows of m float64, `Array[n, m]` likewise (`Array[n, m, float32]` as float32).
The width is known before the start, and the schema hash (names, types, order and the app's class name) keeps robots
with different apps apart.
"""

import enum
import itertools
import math
import numbers
import re
import struct
from collections.abc import Iterable, Mapping, Set
from functools import cache
from hashlib import blake2b
from typing import Annotated, Any, get_args, get_origin

from swarm.core import arrays
from swarm.errors import AppError, FrameError, shown
from swarm.frozen import frozen

Vector = tuple[float, ...]
"""A vector of fixed length; declared as `Annotated[Vector, 2]`."""


Matrix = tuple[Vector, ...]
"""A matrix of fixed size, a tuple of rows; declared as `Annotated[Matrix, 2, 3]`, two rows of three."""


MAX_STATE = 440
"""Largest packed state, bytes: one mesh frame holds two of them (rule R2 of the lockstep)."""

MAX_MEMBERS = 256
"""Members of an enum: they travel as one byte."""

WIRE_TYPES = "float, float32, int, bool, an enum.Enum, Array[n], Annotated[Vector, n] or Annotated[Matrix, n, m]"

MessageValue = float | int | bool | str | tuple[float, ...]
"""A field's value on the bus and in recordings: enums by name, matrices and arrays row by row."""

Item = float | int | bool | enum.Enum | Vector | Matrix | Any
"""The value of one shared field; `Any` stands for a numpy array."""

_INT64 = 1 << 63
_FLOAT32_MAX = struct.unpack("<f", b"\xff\xff\x7f\x7f")[0]


@frozen
class Field:
    """One shared field."""

    name: str
    kind: str
    """float, float32, int, bool, enum, vector, matrix or array."""
    length: int = 1
    """Numbers in it."""
    width: int = 0
    """Columns of a matrix."""
    members: tuple[enum.Enum, ...] = ()
    """The members of an enum, in declared order."""
    sizes: tuple[int, ...] = ()
    """Shape of an array."""
    single: bool = False
    """Whether an array's numbers are float32."""

    @property
    def format(self) -> str:
        """Return the field's `struct` format."""
        numbers = f"{self.length}{'f' if self.single else 'd'}"
        return {"float": "d", "float32": "f", "int": "q", "bool": "?", "enum": "B"}.get(self.kind, numbers)

    @property
    def text(self) -> str:
        """Name and type in one word: what the schema's hash is over."""
        shape = f"{self.length}" if not self.width else f"{self.length // self.width}x{self.width}"
        if self.kind == "array":
            shape = shape_text(self.sizes) + (":float32" if self.single else "")
        return f"{self.name}:{self.kind}:{'|'.join(member.name for member in self.members) or shape}"

    @property
    def shape(self) -> tuple[int, ...]:
        """() of a single value, (n,) of a vector, (n, m) of a matrix, of an array its own."""
        if self.kind == "array":
            return self.sizes
        if self.kind not in ("vector", "matrix"):
            return ()
        return (self.length // self.width, self.width) if self.width else (self.length,)

    @property
    def zero(self) -> Item:
        """The value it has when nothing else was said."""
        if self.kind == "array":
            return arrays.checked((0.0,) * self.length, self.sizes, single=self.single)
        if self.kind == "vector":
            return (0.0,) * self.length
        if self.kind == "matrix":
            return ((0.0,) * self.width,) * (self.length // self.width)
        if self.kind == "enum":
            return self.members[0]
        return {"float": 0.0, "float32": 0.0, "int": 0, "bool": False}[self.kind]

    @property
    def columns(self) -> tuple[str, ...]:
        """Return the field's column names in a table: `q[0]`, `q[1]`... for a vector, `P[0,0]`, `P[0,1]`... for a
        matrix, row by row."""
        return entry_names(self.name, self.shape) if self.shape else (self.name,)

    def check(self, value: object) -> Item:
        """`value` as this field holds it, numbers as floats, lists as tuples; `AppError` says what was wrong."""
        if self.kind == "float":
            return _finite(value)
        if self.kind == "array":
            array = arrays.checked(value, self.sizes, single=self.single)
            if not arrays.are_finite(array):
                raise AppError(f"{shown(value)}: not all of its numbers are finite")
            return array
        if self.kind == "float32":
            number = _finite(value)
            if abs(number) > _FLOAT32_MAX:
                raise AppError(f"{number!r} is beyond the range of float32")
            rounded: float = struct.unpack("<f", struct.pack("<f", number))[0]
            return rounded
        if self.kind == "bool":
            if isinstance(value, bool):
                return value
            if arrays.is_truth(value):
                return bool(value)
            raise AppError(f"expected True or False, got {shown(value)}")
        if self.kind == "int":
            if isinstance(value, numbers.Integral) and not isinstance(value, bool):
                whole = int(value)
                if -_INT64 <= whole < _INT64:
                    return whole
            raise AppError(f"expected an integer of 64 bits, got {shown(value)}")
        if self.kind == "enum":
            return self._member(value)
        if self.kind == "matrix":
            return self._matrix(value)
        if isinstance(value, Iterable) and not isinstance(value, str | bytes | Mapping | Set):
            items = tuple([_finite(item) for item in value])
            if len(items) == self.length:
                return items
        raise AppError(f"expected {self.length} numbers, got {shown(value)}")

    def assigned(self, name: str, value: object) -> Item:
        """Return a new array of this field's type with the numbers that an author assigns. Raises `AppError` for
        another shape."""
        try:
            return arrays.checked(value, self.sizes, single=self.single)
        except AppError as error:
            raise AppError(f"{name}: {error}") from None

    def check_assigned(self, value: object) -> None:
        """Raise `AppError`, with how to mend it, for a value that arithmetic with tuples or an array that is not
        declared has made, while the author's line is still known. All else is checked after the step."""
        if type(value) is tuple and self.kind in ("vector", "matrix"):
            length = self.length // (self.width or 1)
            if len(value) > length and len(value) % length == 0:
                raise AppError(
                    f"{self.name}: expected {length} entries, got {len(value)}. + and * of tuples join and repeat "
                    f"them; for arithmetic declare `{self.name}: {self.as_array}`"
                )
        elif self.kind not in ("vector", "matrix") and (sizes := arrays.shape_of(value)):
            shape = ", ".join(map(str, sizes))
            raise AppError(
                f"{self.name}: it is declared as {self.kind}, and is given an array of shape ({shape}): "
                f"declare `{self.name}: Array[{shape}]`"
            )

    @property
    def as_array(self) -> str:
        """Return the declaration as an array that corresponds to this vector or matrix."""
        return f"Array[{', '.join(map(str, self.shape))}]"

    def message_value(self, value: Any) -> MessageValue:
        """Return a checked value as the bus and recordings carry it."""
        if self.kind == "enum":
            name: str = value.name
            return name
        if self.kind == "matrix":
            return tuple([number for row in value for number in row])
        if self.kind == "array":
            return tuple(value.ravel().tolist())
        same: MessageValue = value
        return same

    def flat(self, value: Any) -> tuple[object, ...]:
        """Return a checked value as the flat tuple of numbers that a frame carries."""
        if self.kind == "enum":
            return (self.members.index(value),)
        if self.kind in ("vector", "matrix", "array"):
            return self.message_value(value)  # type: ignore[return-value]
        return (value,)

    def raised(self, numbers: tuple[Any, ...]) -> Item:
        """Return the value out of the numbers that were packed, an array read-only; `FrameError` for an enum's member
        that is not there."""
        if self.kind == "array":
            return arrays.from_numbers(numbers, self.sizes, single=self.single)
        if self.kind == "vector":
            return numbers
        if self.kind == "matrix":
            return tuple([numbers[at : at + self.width] for at in range(0, self.length, self.width)])
        if self.kind == "enum":
            if numbers[0] >= len(self.members):
                raise FrameError(f"{self.name}: there is no member {numbers[0]}")
            return self.members[int(numbers[0])]
        single: Item = numbers[0]
        return single

    def _member(self, value: object) -> enum.Enum:
        """Return the member that `value` is or names (a configuration has names)."""
        for member in self.members:
            if value is member or (type(value) is str and value == member.name):
                return member
        raise AppError(f"expected {' or '.join(member.name for member in self.members)}, got {shown(value)}")

    def _matrix(self, value: object) -> Matrix:
        """Rows, or what a configuration has for them: all numbers in one list."""
        rows = self.length // self.width
        if isinstance(value, Iterable) and not isinstance(value, str | bytes | Mapping | Set):
            items = tuple(value)
            if len(items) == self.length and all(isinstance(item, numbers.Real) for item in items) and items:
                rows_of = [items[at : at + self.width] for at in range(0, len(items), self.width)]
                return tuple([tuple([_finite(item) for item in row]) for row in rows_of])
            nested = [tuple(row) for row in items if isinstance(row, Iterable) and not isinstance(row, str | bytes)]
            if len(items) == len(nested) == rows and all(len(row) == self.width for row in nested):
                return tuple([tuple([_finite(item) for item in row]) for row in nested])
        raise AppError(f"expected {rows} rows of {self.width} numbers, got {shown(value)}")


class Schema:
    """The shared fields of one app class: names, order, width, hash."""

    def __init__(self, app: str, fields: Iterable[Field]) -> None:
        """`app` is the class name; the fields in declared order."""
        self.app = app
        self.fields = tuple(fields)
        self.names = tuple(field.name for field in self.fields)
        self._struct = struct.Struct("<" + "".join(field.format for field in self.fields))
        self.size = self._struct.size
        """Bytes of one packed state."""
        text = f"{app}({','.join(field.text for field in self.fields)})"
        self.hash = int.from_bytes(blake2b(text.encode(), digest_size=4).digest(), "little")
        """32 bits over class name, names, types and order."""
        self._is_flat = not any(field.kind in ("vector", "matrix", "array", "enum") for field in self.fields)
        self._are_floats = all(field.kind == "float" for field in self.fields)

    @property
    def shapes(self) -> dict[str, str]:
        """`4x4`, by name, of fields with several axes: recordings hold them as one row after the other."""
        return {f.name: shape_text(f.shape) for f in self.fields if len(f.shape) > 1}

    @property
    def members(self) -> dict[str, str]:
        """`IDLE BUSY`, by name, of fields that are an enum: recordings have the names alone."""
        return {f.name: " ".join(member.name for member in f.members) for f in self.fields if f.members}

    @property
    def layout(self) -> str:
        """`value=d x=2d`: each field's name and its format for `struct`."""
        return " ".join(f"{field.name}={field.format}" for field in self.fields)

    def check_size(self) -> None:
        """Raise `AppError` where there is nothing to share, or more than one frame holds."""
        if not self.fields:
            raise AppError(f"{self.app} shares no state: declare at least one field, e.g. `value: float`")
        if self.size > MAX_STATE:
            sizes = ", ".join(f"{f.name} {struct.calcsize('<' + f.format)}" for f in self.fields)
            raise AppError(f"the state of {self.app} takes {self.size} bytes, a frame holds {MAX_STATE} ({sizes})")

    def check(self, values: Mapping[str, object]) -> dict[str, Item]:
        """Return the fields' checked and rounded values, in order; `AppError` names the field at fault."""
        checked: dict[str, Item] = {}
        for field in self.fields:
            try:
                checked[field.name] = field.check(values[field.name])
            except AppError as error:
                raise AppError(f"{field.name}: {error}") from None
        return checked

    def pack(self, values: Mapping[str, object]) -> bytes:
        """Check and pack the fields out of `values`."""
        if self._are_floats:
            found: list[Any] = [values[name] for name in self.names]
            if set(map(type, found)) == {float} and all(map(math.isfinite, found)):
                return self._struct.pack(*found)
        flat: list[object] = []
        for field, value in zip(self.fields, self.check(values).values(), strict=True):
            flat.extend(field.flat(value))
        return self._struct.pack(*flat)

    def unpack(self, data: bytes) -> tuple[Item, ...]:
        """Return the values in declared order. `data` is of this schema's size, whoever took it in has checked;
        `FrameError` where an enum has no such member."""
        flat = self._struct.unpack(data)
        if self._is_flat:
            return flat
        values: list[Item] = []
        at = 0
        for field in self.fields:
            values.append(field.raised(flat[at : at + field.length]))
            at += field.length
        return tuple(values)

    def message_values(self, values: Mapping[str, Any]) -> dict[str, MessageValue]:
        """Checked values for the bus and for recordings, by name."""
        if self._are_floats:
            return {name: values[name] for name in self.names}
        return {field.name: field.message_value(values[field.name]) for field in self.fields}


def type_of(value: object) -> str:
    """Return the type as which a field with this single value is declared; empty where a shared one has none such."""
    if isinstance(value, enum.Enum):
        return type(value).__name__
    kinds = {"bool": bool, "int": numbers.Integral, "float": numbers.Real}
    return next((name for name, kind in kinds.items() if isinstance(value, kind)), "")


def shape_text(shape: tuple[int, ...]) -> str:
    """`4x4`."""
    return "x".join(map(str, shape))


@cache
def entry_names(name: str, shape: tuple[int, ...]) -> tuple[str, ...]:
    """Return the names of the entries of a vector, matrix or array of this shape, in the order in which messages have
    them."""
    places = itertools.product(*map(range, shape))
    return tuple([f"{name}[{','.join(map(str, place))}]" for place in places])


def names_of(name: str, count: int, shape: tuple[int, ...]) -> tuple[str, ...]:
    """Return the names of `count` entries; those of a vector where the shape has another number of them."""
    return entry_names(name, shape if math.prod(shape) == count else (count,))


def field_of(name: str, annotation: object) -> Field:
    """Return the field that an annotation of an app class declares; `AppError` where that type cannot travel."""
    if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", name):
        raise AppError(f"{name}: a shared field's name is of letters a-z, digits and _")
    if annotation in (float, int, bool):
        return Field(name, annotation.__name__)
    if isinstance(annotation, type) and issubclass(annotation, enum.Enum):
        members = tuple(annotation)
        if 0 < len(members) <= MAX_MEMBERS:
            return Field(name, "enum", members=members)
        raise AppError(f"{name}: an enum of 1 to {MAX_MEMBERS} members can be shared, {annotation.__name__} is none")
    if get_origin(annotation) is Annotated:
        base, mark, *more = get_args(annotation)
        if isinstance(mark, arrays.ArrayShape):
            return array_field(name, mark)
        if isinstance(mark, arrays.Float32):
            return Field(name, "float32")
        if base == Vector:
            if type(mark) is int and mark > 0:
                return Field(name, "vector", mark)
            raise AppError(f"{name}: expected Annotated[Vector, n] with n a positive integer, got n = {mark!r}")
        if base == Matrix:
            sizes = (mark, *more)
            if len(sizes) == 2 and all(type(size) is int and size > 0 for size in sizes):
                return Field(name, "matrix", mark * more[0], width=more[0])
            raise AppError(f"{name}: expected Annotated[Matrix, n, m] with n and m positive integers, got {sizes!r}")
    if annotation == Vector:
        raise AppError(f"{name}: say how long the vector is: `{name}: Annotated[Vector, 2]`")
    if annotation == Matrix:
        raise AppError(f"{name}: say how large the matrix is: `{name}: Annotated[Matrix, 2, 3]`")
    kind = getattr(annotation, "__name__", None) or str(annotation)
    if kind in ("Array", "ndarray") or "ndarray[" in kind:
        raise AppError(f"{name}: say the array's shape: `{name}: Array[2]` or `{name}: Array[4, 4]`")
    raise AppError(f"{name}: a shared field is of type {WIRE_TYPES}, not {kind}")


def array_field(name: str, mark: arrays.ArrayShape) -> Field:
    """Return the field that is declared as an array; `AppError` where numpy is missing."""
    try:
        arrays.numpy()
    except AppError as error:
        raise AppError(f"{name}: {error}") from None
    return Field(name, "array", math.prod(mark.sizes), sizes=mark.sizes, single=mark.single)


def _finite(value: object) -> float:
    if type(value) is float and math.isfinite(value):
        return value
    if isinstance(value, numbers.Real) and not isinstance(value, bool):
        try:
            number = float(value)
        except OverflowError:
            number = math.inf
        if math.isfinite(number):
            return number
        raise AppError(f"{shown(value)} is not a finite number")
    raise AppError(f"expected a number, got {shown(value)}")
