"""Memory and age of processes, read from /proc (proc(5))."""

import os
import time
from collections.abc import Iterable
from pathlib import Path

from sim.processes.processes import Child


def commanded() -> float:
    """Return when this run was asked for, on the monotonic clock: before its interpreter was loaded.

    That is when the process began, or what `./run` says, which may have set up the environment before. Both are given
    as time since boot, suspended time included; the difference of the two clocks takes that out.
    """
    ticks = int(Path("/proc/self/stat").read_text().rpartition(")")[2].split()[19])
    boot = float(os.environ.get("SWARM_COMMANDED") or ticks / os.sysconf("SC_CLK_TCK"))
    return boot - (time.clock_gettime(time.CLOCK_BOOTTIME) - time.clock_gettime(time.CLOCK_MONOTONIC))


def resident_mib(children: Iterable[Child]) -> float:
    """Return the resident memory of the children and all they started, MiB. Pages shared by several are counted in
    each."""
    return sum(_memory_kib(pid, "Rss") for child in children for pid in tree(child)) / 1024


def proportional_mib(child: Child) -> float:
    """Return the proportional set size of a child and all it started, MiB: shared pages divided among those who share
    them."""
    return sum(_memory_kib(pid, "Pss") for pid in tree(child)) / 1024


def tree(child: Child) -> list[int]:
    """Return the pids of a child and its descendants."""
    found = [] if child.process is None else [child.process.pid]
    for pid in found:
        for task in Path(f"/proc/{pid}/task").glob("*/children"):
            try:
                found.extend(int(word) for word in task.read_text().split())
            except OSError:
                continue  # it ended while we looked
    return found


def _memory_kib(pid: int, what: str) -> int:
    try:
        for line in Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines():
            if line.startswith(f"{what}:"):
                return int(line.split()[1])
    except OSError:
        pass  # it ended while we looked
    return 0
