"""Zenoh's library, set up for a robot, and how it calls ours. Whoever needs `zenoh` imports it from here."""

import ctypes
import logging
import os
import threading
from collections import Counter
from collections.abc import Callable
from typing import Any

from swarm.errors import SwarmError
from swarm.process.edges import defect

# One worker thread for all of Zenoh's runtimes: 3 threads a client instead of 7, and router CPU for a round
# trip from 305 to 157 us on the measuring machine. Tried with restarts of the router, and with a client and a
# router stopped for longer than the lease of 10 s. Must be set before the library is loaded.
os.environ.setdefault(
    "ZENOH_RUNTIME",
    "(rx:(worker_threads:1),acc:(handover:rx),app:(handover:rx),tx:(handover:rx),net:(handover:rx))",
)

import zenoh

# One arena of the C library's allocator, not one for each thread: what Zenoh's threads give to each other and free
# leaves holes in all of them, and a router grew by 0.5 MB an hour while it held not one byte more. Must be set before
# there are threads.
_M_ARENA_MAX = -8  # malloc.h
ctypes.CDLL(None).mallopt(_M_ARENA_MAX, 1)

_log = logging.getLogger("bus")

counters: Counter[str] = Counter()
"""Counters of this process for its status: `dropped_samples` counts samples and queries that their callback refused."""


def direct(callback: Callable[[Any], None]) -> "zenoh.handlers.Callback[Any]":
    """Return a handler that runs `callback` on Zenoh's own thread. Zenoh's default adds a queue and a thread for
    each."""
    return zenoh.handlers.Callback(guard(callback), indirect=False)


class _Attached(threading.local):
    """Keeps a thread of Zenoh's known to Python. Else each callback makes a thread state and throws it away again, an
    mmap and a munmap: 33 instead of 20 us of CPU time for a sample."""

    attached = True

    def __init__(self) -> None:
        # Never released: the state goes with the process, as the thread does.
        ctypes.pythonapi.PyGILState_Ensure()


_thread = _Attached()


def guard(callback: Callable[[Any], None]) -> Callable[[Any], None]:
    """Keep what a callback raises out of Zenoh's thread, where it would vanish or poison the session.

    An error of ours that has a name (`SwarmError`), such as that of a decoder, costs the sample or query that led to
    it. Any other one is a defect: what the callback works on may be half changed, so a service ends
    (`swarm.process.edges.defect`).
    """

    def guarded(argument: Any) -> None:
        try:
            _thread.attached  # noqa: B018 - the first look in a thread attaches it
            callback(argument)
        except SwarmError as error:
            counters["dropped_samples"] += 1
            _log.warning("a sample or query was dropped: %s", error)
        except Exception as error:  # noqa: BLE001 - whatever it is, it is a defect of the callback
            defect(error, "a bus callback")

    return guarded


def text(error: Exception) -> str:
    """Zenoh's message without the place in its sources."""
    return str(error).partition(" at /")[0]


__all__ = ["counters", "direct", "guard", "text", "zenoh"]
