import importlib
import json
import math
import subprocess
import sys

import pytest

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
