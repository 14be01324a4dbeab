import importlib
import json
import math
import subprocess
import sys

import pytest

from bench import memory
from bench.__main__ import AREAS
from bench.rows import Row


def test_a_row_is_judged_by_its_ratio_to_the_limit():
    good = Row("iteration", 0.033, "s", 0.030, 1.15)
    assert good.ok
    assert json.loads(good.json()) == {
        "name": "iteration", "value": 0.033, "unit": "s", "limit": 0.03, "ratio": 1.1, "goal": 1.15, "ok": True,
    }  # fmt: skip
    assert not Row("iteration", 0.036, "s", 0.030, 1.15).ok
    assert "MISSED" in Row("iteration", 0.036, "s", 0.030, 1.15).text()


def test_what_is_only_told_is_never_missed():
    row = Row("maximum", 1.0, "s", 0.030, None)
    assert row.ok
    assert row.text().endswith("told")
    assert json.loads(row.json())["goal"] is None


@pytest.mark.parametrize("area", AREAS)
def test_every_area_has_rows(area):
    assert callable(importlib.import_module(f"bench.{area}").rows)


def test_what_was_not_measured_is_never_good():
    row = Row("iteration", math.nan, "s", 0.030, 1.15)
    assert not row.ok
    assert json.loads(row.json())["value"] is None


@pytest.mark.parametrize("arguments", [[], ["nonsense"]])
def test_an_area_is_needed(arguments):
    done = subprocess.run([sys.executable, "-m", "bench", *arguments], capture_output=True, text=True, check=False)
    assert done.returncode == 2
    for area in AREAS:
        assert area in done.stderr or not arguments


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_a_smoke_run_of_the_stop_bench_has_all_rows_and_loses_no_stop():
    stop = importlib.import_module("bench.stop")
    rows = list(stop.rows(smoke=True))
    assert [row.name for row in rows if row.goal is not None] == ["stops that were lost"]
    assert len([row for row in rows if "beyond quiet" in row.name]) == len(stop.WAYS) * len(stop.CONDITIONS)
    assert rows[-1].value == 0
    assert all(math.isfinite(row.value) for row in rows)
def test_growth_is_the_slope_of_the_line_with_the_least_squares():
    assert memory.slope([(0.0, 5.0), (1.0, 5.5), (2.0, 6.0)]) == pytest.approx(0.5)
    assert memory.slope([(x, 7.0 + (-1) ** x) for x in range(100)]) == pytest.approx(0.0, abs=1e-3)
    assert math.isnan(memory.slope([(0.0, 5.0)]))


def test_anonymous_memory_is_told_by_what_is_mapped():
    smaps = """55e0-55e9 rw-p 00000000 00:00 0                          [heap]
Rss:                 400 kB
Anonymous:           300 kB
VmFlags: rd wr
7f00-7f10 rw-p 00000000 00:00 0
Anonymous:           100 kB
7f20-7f30 rw-p 00000000 00:00 0
Anonymous:           200 kB
7f40-7f50 r-xp 00000000 fe:00 99                         /usr/lib/libz.so
Anonymous:             0 kB
"""
    assert memory.anonymous_mb(smaps) == pytest.approx({"[heap]": 0.3072, "": 0.3072, "/usr/lib/libz.so": 0.0})


def test_only_areas_that_last_as_long_as_one_wishes_take_a_time():
    done = subprocess.run(
        [sys.executable, "-m", "bench", "session", "--seconds", "1"], capture_output=True, text=True, check=False
    )
    assert done.returncode == 2
    assert "session takes no --seconds" in done.stderr


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_memory_is_measured_of_every_process():
    """Half a minute says nothing about its growth, only that each process is found and looked at."""
    names = [row.name for row in memory.rows(seconds=15.0) if math.isfinite(row.value)]
    assert len(names) == len(set(names)) == 1 + 2 * 7
