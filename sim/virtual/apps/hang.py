"""An app's code that does not return, under virtual time: one process runs all robots, so it would stop them all.

A thread looks once a second which call of an author's code runs. One that it sees for `HANG` s is broken off by an
exception in the thread that runs it; the app's runner makes of it a fault like any other, with robot, iteration and
line. The run itself is not slowed down: nothing is noted where steps begin and end.
"""

import contextlib
import ctypes
import signal
import sys
import threading
from collections.abc import Iterator
from types import FrameType

from services.apps.runner import AppRunner
from swarm.core.asynchronous import HANG

LOOK_S = 1.0
"""Seconds of real time between two looks."""

SIGNAL = signal.SIGURG
"""Signal that breaks off the main thread, even where it sleeps. Nobody else uses it, and it is ignored by default."""


class Hangs(SystemExit):
    """Raised in the author's code. No `Exception`, so that theirs do not catch it by the way."""

    def __init__(self) -> None:
        super().__init__(f"it has not ended within {HANG:g} s")


@contextlib.contextmanager
def broken_off() -> Iterator[None]:
    """Within this, an author's code in this thread that takes longer than `HANG` s is broken off."""
    mine = threading.get_ident()
    # Only the main thread can be interrupted where Python waits; others (a Dask worker's) where it computes.
    interrupts = threading.current_thread() is threading.main_thread()
    before = signal.signal(SIGNAL, _raise) if interrupts else None
    over = threading.Event()

    def watch() -> None:
        seen: FrameType | None = None
        looks = 0
        while not over.wait(LOOK_S):
            running = _authors(sys._current_frames().get(mine))
            looks = looks + 1 if running is not None and running is seen else 0
            seen = running
            if looks * LOOK_S >= HANG:
                looks = 0  # an author's code that catches everything is broken off again
                if interrupts:
                    signal.pthread_kill(mine, SIGNAL)
                else:
                    ctypes.pythonapi.PyThreadState_SetAsyncExc(ctypes.c_ulong(mine), ctypes.py_object(Hangs))

    thread = threading.Thread(target=watch, name="hang", daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()
        if interrupts:
            signal.signal(SIGNAL, before)


def _authors(frame: FrameType | None) -> FrameType | None:
    """Return the call of an author's code that a thread is in; None where it is in none. The frame itself tells one
    call from the next."""
    found = None
    while frame is not None:
        if frame.f_code is AppRunner._call.__code__:
            found = frame
        frame = frame.f_back
    return found


def _raise(number: int, frame: FrameType | None) -> None:
    # It may have ended meanwhile, and what is run now is not the author's.
    if _authors(frame) is not None:
        raise Hangs
