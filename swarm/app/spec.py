"""The declarations of an app's class: state, parameters, the form of a neighbour. They are read when the class is
made."""

import dataclasses
import inspect
import keyword
import typing
from collections import namedtuple
from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, cast

from swarm.app.parameters import KINDS, Parameter
from swarm.core.arrays import ArrayShape
from swarm.core.state import Field, Item, Schema, array_field, field_of
from swarm.errors import AppError
from swarm.frozen import frozen
from swarm.messages.codec import Value

PLATFORM = ("spec", "robot", "k", "name", "age", "neighbours", "finished")
"""Names that no field may have, beside those of the methods."""


PLATFORM_MODULES = ("swarm.app.sync_app", "swarm.app.event_app")
"""The modules with the classes from which apps are derived."""


@frozen
class Spec:
    """The declarations of an app's class, read once when the class is made."""

    schema: Schema
    private: tuple[str, ...]
    arrays: Mapping[str, Field]
    """Fields that are arrays, shared and private ones."""
    parameters: Mapping[str, Parameter]
    view: Any
    """The named tuple in which a step sees a neighbour: `name`, the shared fields and what the kind of app adds."""


def checked(declared: Parameter | Field, name: str, value: object) -> Value | Item:
    """`value` as a parameter or a field takes it; `AppError` with its name."""
    try:
        return declared.check(value)
    except AppError as error:
        raise AppError(f"{name}: {error}") from None


def read_spec(cls: Any) -> Spec:
    """Read the class: annotations are fields or parameters, in declared order, base classes first."""
    if "__init__" in vars(cls) and not _is_platform(cls):
        raise AppError("an app has no __init__; declare fields in the class and set their first values in start()")
    try:
        hints = typing.get_type_hints(cls, include_extras=True)
    except (NameError, TypeError, SyntaxError) as error:
        raise AppError(f"an annotation cannot be read: {error}") from None
    base = next(kind for kind in cls.__mro__ if _is_platform(kind))
    reserved = {name for name in dir(base) if not name.startswith("_")} | set(PLATFORM)
    fields: list[Field] = []
    private: list[str] = []
    arrays: dict[str, Field] = {}
    parameters: dict[str, Parameter] = {}
    for name, hint in hints.items():
        if typing.get_origin(hint) is ClassVar or hint is ClassVar:
            continue
        declared = _declared(cls, name)
        if declared is not None:
            parameters[name] = declared.typed(name, hint, live=cls.live)
        elif name in reserved:
            if name in inspect.get_annotations(cls) and not _is_platform(cls):
                raise AppError(f"{name}: this name belongs to the platform, choose another")
        elif name.startswith("_"):
            private.append(name)
            mark = typing.get_args(hint)[1] if typing.get_origin(hint) is Annotated else None
            if isinstance(mark, ArrayShape):
                arrays[name] = array_field(name, mark)
                _check_first(cls, arrays[name])
        else:
            if keyword.iskeyword(name):
                raise AppError(f"{name}: a word of the Python language cannot be a field")
            fields.append(field_of(name, hint))
            _check_first(cls, fields[-1])
    return Spec(
        Schema(cls.__name__, fields),
        tuple(private),
        arrays | {field.name: field for field in fields if field.kind == "array"},
        parameters,
        namedtuple("Neighbour", ["name", *(f.name for f in fields), *cls.view_extras]),
    )


def _check_first(cls: type, field: Field) -> None:
    """Raise `AppError` for a first value in the class that the field does not take: here the class's line is known."""
    if hasattr(cls, field.name):
        value = getattr(cls, field.name)
        if field.kind != "array":
            field.check_assigned(value)
        checked(field, field.name, value)


def _is_platform(kind: type) -> bool:
    return kind.__module__ in PLATFORM_MODULES


def _declared(cls: type, name: str) -> Parameter | None:
    """Return the parameter of that name, with the plain value that a derived class gives it as its default."""
    values = [vars(kind)[name] for kind in cls.__mro__ if name in vars(kind)]
    found = next((value for value in values if isinstance(value, Parameter)), None)
    if found is None or values[0] is found:
        return found
    if not isinstance(values[0], KINDS):
        raise AppError(f"{name}: it is a parameter, expected parameter(...) or a value for its default")
    return dataclasses.replace(found, default=cast(Value, values[0]))
