"""The page of results: a table for each area, which `./run bench AREA --write` replaces."""

import math
import os
import platform
import re
from collections.abc import Sequence
from pathlib import Path
from textwrap import wrap

from bench.rows import Row
from swarm.errors import SwarmError

PAGE = Path(__file__).parents[1] / "docs/reference/benchmarks.md"
ANY_MACHINE = "virtual time, so the machine and its load do not matter"
HEAD = "| figure | value | unit | limit | ratio | goal | verdict |\n|---|---|---|---|---|---|---|"


def table(area: str, rows: Sequence[Row], *, command: str, machine: str, date: str) -> str:
    """Return an area's part of the page, its marks included: where the figures come from, and a line for each row."""
    where = wrap(f"Measured by `{command}` on {date}: {machine}.", 120, break_long_words=False)
    lines = [*where, "", HEAD, *map(_line, rows)]
    return "\n".join([_begin(area), *lines, _end(area)])


def replaced(page: str, area: str, part: str) -> str:
    """Return the page with an area's part replaced. Raises `SwarmError` where the page has no part of that area."""
    found = re.compile(rf"{re.escape(_begin(area))}.*?{re.escape(_end(area))}", re.DOTALL)
    if len(found.findall(page)) != 1:
        raise SwarmError(f"{PAGE.name}: expected one part between {_begin(area)} and {_end(area)}; add these two lines")
    return found.sub(lambda _: part, page)


def machine() -> str:
    """Return what the figures were measured on, in words: processors, Python, and the load of the last minute, which
    is mostly the measurement's own."""
    return (
        f"{os.cpu_count()} processors {platform.machine()}, {platform.system()} {platform.release()}, "
        f"Python {platform.python_version()}, load average {os.getloadavg()[0]:.1f} with what is measured"
    )


def _begin(area: str) -> str:
    return f"<!-- bench {area} -->"


def _end(area: str) -> str:
    return f"<!-- end of bench {area} -->"


def _line(row: Row) -> str:
    name = row.name.replace("|", "\\|")
    goal = "" if row.goal is None else f"{row.goal:.3g}"
    verdict = "shown" if row.goal is None else "reached" if row.ok else "**missed**"
    ratio = f"{row.ratio:.3g}" if math.isfinite(row.ratio) else ""
    value = f"{row.value:.4g}" if math.isfinite(row.value) else "never" if row.value > 0 else "not measured"
    return f"| {name} | {value} | {row.unit} | {row.limit:.4g} | {ratio} | {goal} | {verdict} |"
