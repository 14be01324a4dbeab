"""The first values and parameters that a program gives to an app, as settings: for all robots, by list, or by robot.

    {"gain": 0.5}                           for all robots
    {"x": [0.5, 1, 2]}                      one for each robot, in their order
    {"x": {"r2": 3.0}}, {"r2": {"x": 3.0}}  of single robots, the others begin as the class says

A field that is a vector takes one vector for all robots, or a list of vectors; numpy arrays are taken like lists.
"""

import enum
from collections.abc import Mapping, Sequence
from typing import Any

from swarm.app.settings import Setting
from swarm.app.sync_app import BaseApp
from swarm.errors import AppError
from swarm.messages.codec import Value


def settings_from_values(kind: type[BaseApp], values: Mapping[str, Any], robots: Sequence[str]) -> list[Setting]:
    """Return the settings, those for all robots first. Raises `AppError` where a list has not one entry for each robot,
    or a robot is unknown; whether the app takes the values is seen when it is made."""
    common: list[Setting] = []
    single: list[Setting] = []
    shapes = {field.name: field.shape for field in kind.spec.schema.fields}
    for name, given in values.items():
        if name in robots and isinstance(given, Mapping):
            single += [Setting(name, inner, _plain(inner, value)) for inner, value in given.items()]
        elif isinstance(given, Mapping):
            if odd := [robot for robot in given if robot not in robots]:
                raise AppError(f"values: {name}: expected values by robot, {', '.join(robots)}; got one of {odd[0]!r}")
            single += [Setting(robot, name, _plain(name, value)) for robot, value in given.items()]
        elif (entries := _for_each(name, given, shapes.get(name, ()), len(robots))) is not None:
            pairs = zip(robots, entries, strict=True)
            single += [Setting(robot, name, _plain(name, value)) for robot, value in pairs]
        else:
            common.append(Setting(None, name, _plain(name, given)))
    return common + single


def _for_each(name: str, given: Any, shape: tuple[int, ...], robots: int) -> list[Any] | None:
    """Return a list's entries where it has one for each robot; None for one value of all."""
    found = _shape(given)
    if not found or found == shape or (len(shape) == 2 and found == (shape[0] * shape[1],)):
        return None
    if len(found) == 1 + len(shape) and found[0] == robots:
        return list(given)
    size = f" of shape {shape}" if shape else ""
    raise AppError(f"values: {name}: expected one value{size}, or one for each of {robots} robots; got shape {found}")


def _shape(given: Any) -> tuple[int, ...]:
    """Return the shape as numpy has it, by the first entries."""
    if isinstance(given, str | bytes) or not hasattr(given, "__len__"):
        return ()
    return (len(given), *(_shape(given[0]) if len(given) else ()))


def _plain(name: str, value: Any) -> Value:
    """Return a value as a configuration holds it: Python's numbers for numpy's, matrices row by row."""
    if isinstance(value, enum.Enum):
        return value.name
    if hasattr(value, "tolist"):  # of numpy, which is not imported for this
        value = value.tolist()
    if isinstance(value, list | tuple):
        numbers: list[float] = []
        for entry in value:
            part = _plain(name, entry)
            numbers += part if isinstance(part, tuple) else (float(part),)
        return tuple(numbers)
    if isinstance(value, float | int | bool | str):
        return value
    raise AppError(f"values: {name}: expected numbers, true or false, or a text, got {value!r}")
