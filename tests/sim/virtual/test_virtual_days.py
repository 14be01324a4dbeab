"""Runs of days: what a run keeps does not grow with its length.

Measured is what Python and the C library have given out at hour 2 and at hour 4 of virtual time. That says as much as a
day: lists that are thinned out to half whenever they are full are as full at any hour as at twice that hour, and all
else that grows does so from hour to hour.
"""

import ctypes
import gc
import os
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from sim.scenario.options import parse
from sim.scenario.scenario import build
from sim.virtual.run import PLACE, VirtualRun

HOUR = 3600.0
WARM_UP_H, END_H = 2.0, 4.0
LIMIT_B_H = 0.2e6
"""Bytes an hour of virtual time."""
BLOCK_B = 64
"""Bytes of one of Python's blocks, on average; the largest has 512."""

pytestmark = [
    pytest.mark.slow,
    pytest.mark.timeout(1800),
    pytest.mark.skipif("SWARM_DAYS" not in os.environ, reason="takes minutes of CPU time: set SWARM_DAYS=1"),
]


_FIELDS = (
    "arena", "ordblks", "smblks", "hblks", "hblkhd", "usmblks", "fsmblks", "uordblks", "fordblks", "keepcost",
)  # fmt: skip


class MallInfo(ctypes.Structure):
    """`struct mallinfo2` of mallinfo(3)."""

    _fields_ = tuple((name, ctypes.c_size_t) for name in _FIELDS)


def given_out() -> float:
    """Bytes that this process holds: Python's blocks, and what is larger and so comes from the C library.

    What nothing refers to any more does not count: Python frees cycles of objects at a moment of its own choice.
    """
    gc.collect()
    mallinfo2 = ctypes.CDLL(None).mallinfo2
    mallinfo2.restype = MallInfo
    found = mallinfo2()
    return float(sys.getallocatedblocks() * BLOCK_B + found.uordblks + found.hblkhd)


def growth(run: VirtualRun) -> float:
    """Bytes an hour, between `WARM_UP_H` and `END_H`."""
    found: dict[float, float] = {}

    def look(hour: float) -> Callable[[], None]:
        return lambda: found.__setitem__(hour, given_out())

    for hour in (WARM_UP_H, END_H):
        run.world.time.at(hour * HOUR, look(hour))
    run.go()
    return (found[END_H] - found[WARM_UP_H]) / (END_H - WARM_UP_H)


def test_what_is_kept_is_seen_whether_it_is_small_or_large() -> None:
    before = given_out()
    small = [[number] for number in range(10_000)]
    large = bytes(1 << 20)
    assert given_out() - before > len(small) * BLOCK_B + len(large)


@pytest.mark.parametrize(
    ("app", "recorded"),
    [("consensus", True), ("led_sync", False), ("formation", False)],
    ids=["a recorded lockstep", "flashes that are watched", "places that are watched"],
)
def test_four_hours_of_a_simulation_take_no_more_memory_than_two(
    app: str, recorded: bool, tmp_path: Path, record_property: Callable[[str, object], None]
) -> None:
    words = [app, "--robots", "2", "--virtual", "--body", "point", "--seconds", str(END_H * HOUR + 60)]
    words += ["--mesh", "delay"] if app == "consensus" else []
    words += ["--record", str(tmp_path)] if recorded else []
    options = parse(words)
    found = growth(VirtualRun(options, build(options, PLACE)))
    record_property("measured", f"{found / 1e6:.3f} MB an hour of virtual time (limit {LIMIT_B_H / 1e6})")
    assert found <= LIMIT_B_H
