"""Fields that are numpy arrays: `x: Array[2]`, `P: Array[4, 4]`, `q: Array[3, float32]`.

numpy is imported when a class declares an array, and never before: apps without arrays, and all other processes of a
robot, do without it.
"""

from typing import TYPE_CHECKING, Annotated, Any

from swarm.errors import AppError, shown
from swarm.frozen import frozen

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Numbers = NDArray[Any]

MAX_DIMENSIONS = 4
"""Axes of a field that is an array."""

MENDS = (
    'on a robot write `[robot] packages = ["numpy"]` into swarm.toml and deploy again; on a laptop: pip install numpy'
)


@frozen
class ArrayShape:
    """The shape that an author declares in the brackets of `Array[...]`."""

    sizes: tuple[int, ...]
    single: bool
    """Whether its numbers are IEEE 754 binary32."""


class Float32:
    """Marks a float that travels as IEEE 754 binary32."""


float32 = Annotated[float, Float32()]
"""A float that takes 4 bytes in a message. The robot's own value is rounded, too, so all robots use the same number."""


class Array:
    """The annotation of a field that is a numpy array of float64, or float32 on request. Its shape never changes.
    Raises `AppError` if a size is not a positive integer."""

    def __class_getitem__(cls, sizes: Any) -> Any:
        given = sizes if isinstance(sizes, tuple) else (sizes,)
        single = bool(given) and (given[-1] == float32 or getattr(given[-1], "__name__", "") == "float32")  # numpy's
        sizes = given[:-1] if single else given
        if not 0 < len(sizes) <= MAX_DIMENSIONS or any(type(size) is not int or size < 1 for size in sizes):
            kinds = ", ".join("float32" if each == float32 else repr(each) for each in given)
            raise AppError(
                f"Array[{kinds}]: expected positive integers, as in Array[2], Array[4, 4], Array[2, float32]"
            )
        return Annotated[Array, ArrayShape(sizes, single)]


def numpy() -> Any:
    """Return the module; raises `AppError`, which says how to get it, where it is not there."""
    try:
        import numpy as np
    except ImportError:
        raise AppError(f"arrays need numpy, which is not installed here: {MENDS}") from None
    return np


def checked(value: object, shape: tuple[int, ...], *, single: bool) -> "Numbers":
    """Return a new array of this shape with the numbers of `value`: an array, nested lists, or all numbers in one
    list, one row after the other. Raises `AppError` for another shape and for entries that are no numbers."""
    np = numpy()
    kind = np.float32 if single else np.float64
    try:
        given = np.asarray(value)
    except (TypeError, ValueError, OverflowError):
        given = np.array(None)
    if given.dtype.kind not in "biuf":
        raise AppError(f"expected an array of {' x '.join(map(str, shape))} numbers, got {shown(value)}")
    with np.errstate(over="ignore"):  # beyond float32: it is not finite, which is told by its name
        found = np.array(given, dtype=kind)
    if found.shape != shape and found.ndim == 1 and isinstance(value, tuple | list) and found.size == _size(shape):
        found = found.reshape(shape)
    if found.shape != shape:
        raise AppError(f"expected an array of shape {shape}, got shape {found.shape}: {shown(value)}")
    array: Numbers = found
    return array


def are_finite(array: Any) -> bool:
    """Return whether all its numbers are."""
    return bool(numpy().isfinite(array).all())


def from_numbers(numbers: tuple[float, ...], shape: tuple[int, ...], *, single: bool) -> "Numbers":
    """Return the array out of its packed numbers, which cannot be written to."""
    np = numpy()
    array: Numbers = np.array(numbers, dtype=np.float32 if single else np.float64).reshape(shape)
    array.setflags(write=False)
    return array


def is_array(value: object) -> bool:
    """Return whether it is an array of numpy, one number of it included: told without importing that."""
    return type(value).__module__ == "numpy" and hasattr(value, "dtype")


def is_truth(value: object) -> bool:
    """Return whether it is numpy's True or False, which comparisons of an array's entries give."""
    return is_array(value) and value.dtype.kind == "b" and value.shape == ()  # type: ignore[attr-defined]


def shape_of(value: object) -> tuple[int, ...]:
    """Return the shape of an array; empty for a single number and for any other value."""
    return tuple(getattr(value, "shape", ())) if is_array(value) else ()


def pack(value: Any) -> tuple[str, list[int] | None, bytes]:
    """Pack an array, or a single number of numpy, into values that msgpack holds. Raises `TypeError` for objects."""
    if value.dtype.kind not in "biufc":
        raise TypeError(f"type {value.dtype}")
    shape = list(value.shape) if isinstance(value, numpy().ndarray) else None
    return value.dtype.str, shape, value.tobytes()


def unpack(kind: str, shape: list[int] | None, data: bytes) -> Any:
    """Unpack what `pack` has packed."""
    array = numpy().frombuffer(data, dtype=kind)
    return array[0] if shape is None else array.reshape(shape).copy()


def _size(shape: tuple[int, ...]) -> int:
    size = 1
    for each in shape:
        size *= each
    return size
