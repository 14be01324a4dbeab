"""The end of a process, with its interpreter's end or without."""

import contextlib
import os
import sys
import threading
from typing import NoReturn

OPENER = "bus-open"
"""Name of the thread in which a session of Zenoh is opened (swarm/bus/zenoh_bus.py)."""


def leave(code: int) -> NoReturn:
    """End this process with an exit code.

    Two kinds of threads do not let the interpreter end, and then the process ends without that. After an error the main
    function may have left threads running, and the interpreter would wait for them for ever. A thread that still opens
    a session of Zenoh may return while the interpreter ends, which would abort the process.
    """
    others = [thread for thread in threading.enumerate() if thread is not threading.main_thread()]
    if any(thread.name == OPENER for thread in others) or (code and any(not thread.daemon for thread in others)):
        for stream in (sys.stdout, sys.stderr):
            with contextlib.suppress(OSError):
                stream.flush()
        os._exit(code)
    sys.exit(code)
