"""What goes wrong in an author's code in words: file, line, fault, and how to mend it."""

import sys
import traceback
from collections.abc import Iterable

from swarm.core.state import Field
from swarm.errors import AppError, cut

LONGEST = 2000
"""Letters of a fault's description: it goes out with the app's progress, whose message is bounded."""


def called_from(error: BaseException, source: str) -> str:
    """File and line of the author's call that our own code has refused; empty where the author has raised it."""
    frames = traceback.extract_tb(error.__traceback__)
    mine = [frame for frame in frames if frame.filename == source]
    return f"{source}, line {mine[-1].lineno}: " if mine and mine[-1] is not frames[-1] else ""


def mend_of(error: BaseException, fields: Iterable[Field]) -> str:
    """Explain how to mend common errors of authors: arithmetic with tuples or None, a change of a neighbour's array,
    a misspelled name. Empty for other errors."""
    tuples = [field for field in fields if field.kind in ("vector", "matrix")]
    if tuples and isinstance(error, TypeError) and any(word in str(error) for word in ("tuple", "sequence")):
        first = tuples[0]
        return f" ({first.name} is a tuple, which cannot compute: declare `{first.name}: {first.as_array}`)"
    if isinstance(error, TypeError | AttributeError) and "NoneType" in str(error):
        return " (a pose, its heading, a distance and the mesh's time are None as long as they are not known)"
    if isinstance(error, ValueError) and "read-only" in str(error):
        return " (a neighbour's array cannot be changed: compute another one of it, as `n.x + 1` does)"
    if isinstance(error, AttributeError) and error.obj is not None and error.name is not None:
        import difflib  # of mistakes alone: robots do without it

        near = difflib.get_close_matches(error.name, [name for name in dir(error.obj) if name[0] != "_"], 1)
        if not near and hasattr(error.obj, "_fields"):
            return f" (it has {', '.join(error.obj._fields)})"
        return f" (is {near[0]!r} meant?)" if near else ""
    if isinstance(error, AttributeError) and str(error) == "can't set attribute":
        return " (a named tuple, as a neighbour is, cannot be changed: assign to self)"
    return ""


def bounded(error: BaseException) -> str:
    """Return an error's text, cut where it is very long."""
    return cut(str(error), LONGEST)


def line_of(thread: int | None, source: str) -> str:
    """Return file, line and method of the author's code that runs in a thread, with a colon; empty where none does."""
    frame = None if thread is None else sys._current_frames().get(thread)
    while frame is not None and frame.f_code.co_filename != source:
        frame = frame.f_back
    return "" if frame is None else f"{source}, line {frame.f_lineno}, in {frame.f_code.co_name}(): "


def describe(error: BaseException, source: str, otherwise: str = "") -> str:
    """Describe an author's error in one line: file, line, kind, text. The line is the deepest one within `source`;
    where there is none the place is `otherwise`, with a colon, or the deepest line of all."""
    if isinstance(error, SyntaxError) and error.lineno is not None:
        return f"{error.filename}, line {error.lineno}: {type(error).__name__}: {error.msg}"
    frames = traceback.extract_tb(error.__traceback__)
    mine = [frame for frame in frames if frame.filename == source] or ([] if otherwise else frames)
    place = f"{mine[-1].filename}, line {mine[-1].lineno}: " if mine else otherwise
    kind = "" if isinstance(error, AppError) else f"{type(error).__name__}: "
    return f"{place}{kind}{' '.join(str(error).splitlines())}"
