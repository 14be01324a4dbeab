"""The settings that keep the loop on time on a busy machine, each where permitted: priority, locked memory, no
collector."""

import ctypes
import gc
import logging
import os
import resource

PRIORITY = 40
"""SCHED_FIFO, below the kernel's interrupt threads (50)."""

_MCL_CURRENT, _MCL_FUTURE, _MCL_ONFAULT = 1, 2, 4  # bits/mman-linux.h


def enter(log: logging.Logger) -> None:
    """Make this process real-time as far as it may. What is refused is logged and does without."""
    try:
        # Children start without the priority: the bridge must never compete with the loop.
        os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(PRIORITY))
    except PermissionError:
        log.warning("no real-time priority: the loop may be late on a busy machine (needs LimitRTPRIO or root)")
    unlimited = resource.getrlimit(resource.RLIMIT_MEMLOCK)[0] == resource.RLIM_INFINITY
    # With a limit, memory beyond it could not be allocated at all any more: rather not lock.
    if not (unlimited or os.geteuid() == 0):
        log.warning("memory is not locked: LimitMEMLOCK is not infinity")
    # Only pages in use: all of the libraries' pages would take some 10 MiB more.
    elif ctypes.CDLL(None, use_errno=True).mlockall(_MCL_CURRENT | _MCL_FUTURE | _MCL_ONFAULT) != 0:
        log.warning("memory is not locked: mlockall: %s", os.strerror(ctypes.get_errno()))
    gc.collect()
    gc.freeze()
    gc.disable()  # the loop makes no cycles; reference counts do the rest
