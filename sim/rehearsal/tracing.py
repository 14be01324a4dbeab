"""The search for the line of an app's file that makes a step go wrong: the step is done again, line by line."""

import builtins
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from types import FrameType
from typing import Any

from services.apps.runner import AppRunner
from swarm.errors import AppError

Values = Mapping[str, object]


def line_of(kind: type, method: str) -> int:
    """Return the first line of an app's method, for a problem that has no single line."""
    code = getattr(getattr(kind, method, None), "__code__", None)
    return int(code.co_firstlineno) if code is not None else 1


def bad_line(runner: AppRunner, source: str, act: Callable[[], object]) -> int | None:
    """Return the line after which a shared field first held a value that is not of its type. None where `act` leaves
    all fields as they must be."""
    schema, app = runner.schema, runner.app

    def wrong() -> bool:
        try:
            schema.check({name: getattr(app, name) for name in schema.names})
        except AppError:
            return True
        return False

    found: list[int] = []

    def look(line: int, frame: FrameType) -> None:
        if not found and wrong():
            found.append(line)

    _traced(source, act, look)
    return found[0] if found else None


def differing_line(runner: AppRunner, source: str, act: Callable[[], object]) -> int | None:
    """Return the line after which two runs of `act` first differ, in the app's fields or in local numbers and texts;
    None where they do not. `act` brings the app back to where it began, first."""
    histories: list[list[tuple[int, Values]]] = []
    names = (*runner.schema.names, *type(runner.app).spec.private)
    for _ in range(2):
        history: list[tuple[int, Values]] = []

        def look(line: int, frame: FrameType, history: list[tuple[int, Values]] = history) -> None:
            values: dict[str, object] = {f"self.{name}": getattr(runner.app, name, None) for name in names}
            values |= {k: v for k, v in frame.f_locals.items() if isinstance(v, float | int | str | tuple | list)}
            history.append((line, {name: repr(value) for name, value in values.items()}))

        _traced(source, act, look)
        histories.append(history)
    for (line, one), (_, other) in zip(histories[0], histories[1], strict=False):
        if one != other:
            return line
    return None


@contextmanager
def float_sums() -> Iterator[set[tuple[str, int]]]:
    """Yield the files and lines that meanwhile add floats by `sum`, which rounds in another way from Python 3.12 on."""
    found: set[tuple[str, int]] = set()
    plain = builtins.sum

    def watched(numbers: Iterable[Any], /, start: Any = 0) -> Any:
        total = plain(numbers, start)
        if isinstance(total, float):
            frame = sys._getframe(1)
            found.add((frame.f_code.co_filename, frame.f_lineno))
        return total

    builtins.sum = watched
    try:
        yield found
    finally:
        builtins.sum = plain


def _traced(source: str, act: Callable[[], object], look: Callable[[int, FrameType], None]) -> None:
    """Call `look(line, frame)` after each line of `source` that `act` runs."""

    def begin(frame: FrameType, event: str, argument: Any) -> Callable[..., Any] | None:
        if frame.f_code.co_filename != source:
            return None
        line = frame.f_lineno

        def follow(frame: FrameType, event: str, argument: Any) -> Callable[..., Any]:
            nonlocal line
            if event in ("line", "return"):
                look(line, frame)
                line = frame.f_lineno
            return follow

        return follow

    before = sys.gettrace()
    sys.settrace(begin)
    try:
        act()
    except AppError:
        return  # what it raises is known already
    finally:
        sys.settrace(before)
