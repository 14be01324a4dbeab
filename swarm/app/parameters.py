"""Parameters of an app: settings with type, unit and range, that the app's own code cannot change."""

import dataclasses
import math
import typing
from collections.abc import Sequence
from typing import Annotated, Any

from swarm.core.arrays import is_array, shape_of
from swarm.errors import AppError
from swarm.frozen import frozen
from swarm.messages.codec import Value

KINDS = (float, int, bool, str)
"""Types that a parameter may have."""


@frozen
class Parameter:
    """One declared parameter."""

    default: Value
    unit: str = ""
    low: float | None = None
    high: float | None = None
    choices: tuple[str, ...] = ()
    live: bool | None = None
    """Whether it may be changed while the app runs; None: the kind of app decides."""
    kind: type = float
    """The annotation: float, int, bool or str."""

    def expected(self) -> str:
        """Return in words what a value must be."""
        if self.choices:
            return " or ".join(map(repr, self.choices))
        words = {float: "a finite number", int: "an integer", bool: "true or false", str: "a text"}[self.kind]
        if self.low is not None and self.high is not None:
            words += f" from {self.low:g} to {self.high:g}"
        elif self.low is not None:
            words += f" of at least {self.low:g}"
        elif self.high is not None:
            words += f" of at most {self.high:g}"
        return words + (f" in {self.unit}" if self.unit not in ("", "1") else "")

    def check(self, value: object) -> Value:
        """`value` as the app gets it; `AppError` with what was expected."""
        if is_array(value) and not shape_of(value):
            value = value.item()  # type: ignore[attr-defined]  # such as numpy's pi / 4 in a default
        if self.kind is float and type(value) is int:
            value = float(value)
        fits = type(value) is self.kind and (not self.choices or value in self.choices)
        if fits and isinstance(value, int | float):
            fits = (
                math.isfinite(value)
                and (self.low is None or value >= self.low)
                and (self.high is None or value <= self.high)
            )
        if not fits:
            raise AppError(f"expected {self.expected()}, got {value!r}")
        return typing.cast(Value, value)

    def typed(self, name: str, hint: object, *, live: bool) -> "Parameter":
        """Return the parameter with the type of the annotation `hint`, its default checked. `live` counts where
        the parameter does not say."""
        kind = typing.get_args(hint)[0] if typing.get_origin(hint) is Annotated else hint
        if kind not in KINDS:
            shown = getattr(kind, "__name__", kind)
            raise AppError(f"{name}: a parameter is of type float, int, bool or str, not {shown}")
        typed = dataclasses.replace(self, kind=kind, live=live if self.live is None else self.live)
        try:
            return dataclasses.replace(typed, default=typed.check(self.default))
        except AppError as error:
            raise AppError(f"{name}: default: {error}") from None


def value_of(text: str) -> Value:
    """Parse a value of a command line: 1, 0.5, true, [1,2], [[1,0],[0,1]] or a text. Numbers of nested lists follow
    each other, row by row. Raises `AppError` for an incomplete list."""
    if text in ("true", "false"):
        return text == "true"
    if text.startswith("[") and text.endswith("]"):
        try:
            return tuple(_numbers_in(text))
        except ValueError:
            raise AppError(f"{text!r} is not a list of numbers such as [0.5,1] or [[1,0],[0,1]]") from None
    return number_or_text(text)


def split_at_commas(text: str) -> list[str]:
    """Return the parts of a text between commas that are not within brackets, without spaces around them."""
    parts, depth = [""], 0
    for letter in text:
        depth += (letter == "[") - (letter == "]")
        if letter == "," and depth == 0:
            parts.append("")
        else:
            parts[-1] += letter
    return [part.strip() for part in parts]


def _numbers_in(text: str) -> list[float]:
    """Return the numbers of a list, row by row. Raises `ValueError` where rows are of different lengths."""
    if not (text.startswith("[") and text.endswith("]")):
        return [float(text)]
    rows = [_numbers_in(part) for part in split_at_commas(text[1:-1]) if part]
    if len({*map(len, rows)}) > 1:
        raise ValueError(text)
    return [number for row in rows for number in row]


def number_or_text(text: str) -> int | float | str:
    """Return the number that a text is, or the text."""
    for convert in (int, float):
        try:
            return convert(text)
        except ValueError:
            continue
    return text


def parameter(
    default: Value,
    *,
    unit: str = "",
    low: float | None = None,
    high: float | None = None,
    choices: Sequence[str] = (),
    live: bool | None = None,
) -> Any:
    """Declare a parameter: `gain: float = parameter(0.5, unit="1", low=0, high=1)`.

    Its value comes from `[apps.NAME]` of swarm.toml, from `[apps.NAME.robots.ROBOT]`, or from `--set`. While the app
    runs, `swarm app param` changes a `live` one. In event-driven and periodic apps all are, unless `live=False`.
    In synchronous ones none is, unless `live=True`: the robots then change it at different iterations, and a run can
    no longer be repeated bit for bit.
    """
    return Parameter(default, unit, low, high, tuple(choices), live)
