"""Time of a lockstep iteration, app to app through bus and mesh, beside the one-way latency of the links."""

import math
from collections.abc import Iterator

from bench.rows import Row
from bench.simulation import simulate

LATENCY_S = 0.03
"""One way, as the thesis' radio at small payloads (round trip 59 ms for 50 bytes, figure 3.19)."""

ZERO_GOAL_S = 2.5e-3
"""Budget of an iteration where the links take no time: what bus, mesh and app cost themselves."""

START_LIMIT_S = 6.0


def rows() -> Iterator[Row]:
    """Measure; yields rows as they are there."""
    starts = []
    for topology, goal in (("line", 1.15), ("loop", 1.15), ("full", 1.2)):
        run = simulate("consensus", "--robots", "6", "--topology", topology, "--latency", f"{LATENCY_S}s",
                       "--iterations", "300")  # fmt: skip
        yield Row(f"lockstep {topology} 6, 30 ms links", number(run, "iteration_s_median"), "s", LATENCY_S, goal)
        starts.append(number(run, "started_s"))
        if topology == "line":
            yield Row("messages an iteration, line 6", number(run, "messages_per_iteration"), "", 10.0, 1.02)
    run = simulate("consensus", "--robots", "3", "--latency", "0ms", "--iterations", "2000")
    yield Row("lockstep line 3, 0 ms links", number(run, "iteration_s_median"), "s", ZERO_GOAL_S, 1.0)
    yield Row("start of 6 robots, command to first iteration", max(starts), "s", START_LIMIT_S, 1.0)


def number(run: dict[str, object], name: str) -> float:
    """A figure of the report; nan where the run did not give it."""
    value = run[name]
    return float(value) if isinstance(value, int | float) else math.nan
