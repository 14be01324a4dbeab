"""A day of virtual time: what a run keeps does not grow with its length."""

import os
import sys
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import pytest

from sim.options import parse
from sim.scenario import build
from sim.virtual.run import PLACE, VirtualRun

HOUR = 3600.0
LIMIT_B_H = 0.2e6
"""Bytes an hour of virtual time."""
BLOCK_B = 64
"""Bytes of one of Python's blocks, on average; the largest has 512."""

pytestmark = [
    pytest.mark.slow,
    pytest.mark.timeout(3000),
    pytest.mark.skipif("SWARM_DAYS" not in os.environ, reason="takes a quarter of an hour of CPU: set SWARM_DAYS=1"),
]


def blocks_and_bytes(run: VirtualRun, warm_up: float, traced: float, hours: float) -> tuple[float, float]:
    """Growth between `warm_up` and `traced`, in Python's blocks, and between the hour after `traced` and the end, in
    bytes of all that Python has asked for; an hour. (To trace is slow, so only the end is.)"""
    found: dict[float, int] = {}

    def at(hour: float, measure: Callable[[], int]) -> None:
        run.world.time.at(hour * HOUR, lambda: found.__setitem__(hour, measure()))

    at(warm_up, sys.getallocatedblocks)
    at(traced - 0.01, sys.getallocatedblocks)
    run.world.time.at(traced * HOUR, tracemalloc.start)
    for hour in (traced + 1.0, hours):
        at(hour, lambda: tracemalloc.get_traced_memory()[0])
    try:
        run.go()
    finally:
        tracemalloc.stop()
    blocks = (found[traced - 0.01] - found[warm_up]) / (traced - warm_up)
    return blocks, (found[hours] - found[traced + 1.0]) / (hours - traced - 1.0)


@pytest.mark.parametrize(
    ("app", "recorded"),
    [("consensus", True), ("led_sync", False), ("formation", False)],
    ids=["a recorded lockstep", "flashes that are watched", "places that are watched"],
)
def test_a_day_of_a_simulation_takes_no_more_memory_than_an_hour(app: str, recorded: bool, tmp_path: Path) -> None:
    words = [app, "--robots", "2", "--virtual", "--body", "point", "--seconds", str(24 * HOUR + 60)]
    words += ["--mesh", "delay"] if app == "consensus" else []
    words += ["--record", str(tmp_path)] if recorded else []
    options = parse(words)
    blocks, size = blocks_and_bytes(VirtualRun(options, build(options, PLACE)), 2.0, 21.0, 24.0)
    assert blocks * BLOCK_B <= LIMIT_B_H
    assert size <= LIMIT_B_H
