"""The progress of a computation: a line on a terminal or in a notebook, nothing elsewhere."""

import contextlib
import sys
import time
from collections.abc import Callable, Iterator

from swarm.process.terminal import BAR, steer

PATIENCE_S, EVERY_S = 0.5, 0.1
"""Seconds after which the line is first drawn, and between two times: what ends sooner needs none."""


@contextlib.contextmanager
def progress(what: str, *, shown: bool = True) -> Iterator[Callable[[float], None]]:
    """Yield a function that takes the share of a computation that is done, 0 to 1, and draws it."""
    stream = sys.stderr
    shown = shown and (stream.isatty() or "ipykernel" in sys.modules)
    due = time.monotonic() + PATIENCE_S
    drawn = False

    def look(share: float) -> None:
        nonlocal due, drawn
        if shown and time.monotonic() >= due:
            full = int(BAR * share)
            steer(stream, f"\r{what} [{'#' * full}{'.' * (BAR - full)}] {share:4.0%}")
            stream.flush()
            due, drawn = time.monotonic() + EVERY_S, True

    try:
        yield look
    finally:
        if drawn:
            steer(stream, f"\r{' ' * (len(what) + BAR + 8)}\r")
            stream.flush()
