import json
import math
import os
import shutil
import statistics
import subprocess
import sys

import pytest

from bench import __main__ as program
from bench import page
from bench.__main__ import AREAS
from bench.costs import memory
from bench.rows import Row, measured, possible
from swarm.errors import SwarmError


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
    assert row.text().endswith("shown")
    assert json.loads(row.json())["goal"] is None


@pytest.mark.parametrize("area", AREAS)
def test_every_area_has_sizes_for_its_figures_and_for_a_smoke_run(area):
    module = program.area_module(area)
    assert callable(module.rows)
    assert isinstance(module.FULL, module.Sizes)
    assert isinstance(module.SMOKE, module.Sizes)


@pytest.mark.parametrize("area", AREAS)
def test_the_page_of_results_has_one_table_for_every_area(area):
    text = page.PAGE.read_text(encoding="utf-8")
    part = page.table(area, [], command="c", machine="m", date="d")
    new = page.replaced(text, area, part)
    assert new.count(part) == 1
    before = text[text.index(f"<!-- bench {area} -->") : text.index(f"<!-- end of bench {area} -->")]
    assert page.HEAD in before
    assert f"`./run bench {area}" in before


def test_lines_of_prose_that_are_written_fit_the_page():
    part = page.table("radio", [], command="./run bench radio", machine="a machine with a long name " * 5, date="d")
    assert max(map(len, part.splitlines())) <= 120


def test_a_table_that_is_written_takes_the_place_of_the_old_one_alone(monkeypatch, tmp_path, capsys):
    rows = [Row("a | b", 0.033, "s", 0.030, 1.15), Row("told", math.nan, "s", 0.03, None), Row("late", 2.0, "s", 1, 1)]
    rows.append(Row("gone", math.inf, "s", 1, None))
    monkeypatch.setattr(program, "measure", lambda area, **_: iter(rows))
    monkeypatch.setattr(page, "PAGE", tmp_path / "page.md")
    other = page.table("stop", rows, command="c", machine="m", date="2026-01-01")
    old = page.table("mesh", [], command="c", machine="m", date="2026-01-01")
    page.PAGE.write_text(f"# Results\n\n{other}\n\nWords.\n\n{old}\n\nMore.\n")
    monkeypatch.setattr(sys, "argv", ["bench", "mesh", "--write"])
    assert program.main() == 1
    before, _, rest = page.PAGE.read_text().partition("Words.\n\n")
    assert before == f"# Results\n\n{other}\n\n"
    assert rest.endswith("<!-- end of bench mesh -->\n\nMore.\n")
    assert "Measured by `./run bench mesh` on 2" in rest
    assert "| a \\| b | 0.033 | s | 0.03 | 1.1 | 1.15 | reached |" in rest
    assert "| told | not measured | s | 0.03 |  |  | shown |" in rest
    assert "| late | 2 | s | 1 | 2 | 1 | **missed** |" in rest
    assert "| gone | never | s | 1 |  |  | shown |" in rest
    assert len(capsys.readouterr().out.splitlines()) == len(rows)


def test_an_area_that_fails_does_not_take_the_rows_of_the_others(monkeypatch, capsys):
    def measure(area, **_):
        yield Row(f"of {area}", 1.0, "s", 1.0, 1.0)
        if area == "mesh":
            raise KeyError("no such robot")

    monkeypatch.setattr(program, "measure", measure)
    monkeypatch.setattr(sys, "argv", ["bench", "all"])
    assert program.main() == program.FAILED
    out, err = capsys.readouterr()
    assert [line.split()[1] for line in out.splitlines()] == list(AREAS)
    assert "bench mesh: it failed" in err
    assert "no such robot" in err


def test_a_page_without_a_place_for_the_table_is_refused():
    with pytest.raises(SwarmError, match="<!-- bench mesh -->"):
        page.replaced("# Results\n", "mesh", "")


def test_figures_of_a_smoke_run_are_not_written(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["bench", "mesh", "--write", "--smoke"])
    with pytest.raises(SystemExit) as ended:
        program.main()
    assert ended.value.code == 2
    assert "full sizes" in capsys.readouterr().err


NEEDS = {"balancer": "cyclictest", "deploy": "sshd", "view": "chromium"}
"""Programs without which an area cannot be measured. CI has them all."""


def smoke(area):
    """A smoke run of one area: seconds of work, so that no area is broken without being noticed."""
    program = NEEDS.get(area)
    path = f"{os.environ['PATH']}:/usr/sbin:/sbin"
    missing = program is not None and not os.environ.get("CI") and shutil.which(program, path=path) is None
    # A machine of the lab takes minutes to build.
    marks = [pytest.mark.lab if area == "lab" else pytest.mark.slow, pytest.mark.timeout(600)]
    return pytest.param(area, marks=[*marks, pytest.mark.skipif(missing, reason=f"needs {program}")])


@pytest.mark.parametrize("area", [smoke(area) for area in AREAS])
def test_a_smoke_run_of_an_area_measures_something(area):
    command = [sys.executable, "-m", "bench", area, "--smoke", "--json"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    rows = [json.loads(line) for line in done.stdout.splitlines()]
    assert rows
    assert all(row["goal"] is None for row in rows)
    if area != "teamwork":  # its robots have no time to come together
        assert [row["name"] for row in rows if row["value"] is None or math.isnan(row["value"])] == [], "not measured"


def test_an_option_that_an_area_does_not_have_is_refused():
    command = [sys.executable, "-m", "bench", "session", "--seed", "3"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert "session has no --seed" in done.stderr


def test_what_was_not_measured_is_never_good():
    row = Row("iteration", math.nan, "s", 0.030, 1.15)
    assert not row.ok
    assert json.loads(row.json())["value"] is None


@pytest.mark.parametrize("values", [[math.nan, 1.0, 2.0], [1.0, 2.0, math.nan], []])
def test_a_largest_value_is_not_known_where_one_was_not_measured(values):
    assert math.isnan(max(measured(values)))
    assert math.isnan(min(measured(values)))
    assert math.isnan(statistics.median(measured(values)))
    assert max(measured([1.0, 2.0])) == 2.0


def test_a_count_below_what_is_possible_is_not_known():
    assert possible(10, 10) == 10
    assert possible(12.5, 10) == 12.5
    assert math.isnan(possible(9.9, 10))
    assert math.isnan(possible(math.nan, 0))


@pytest.mark.parametrize("arguments", [[], ["nonsense"]])
def test_an_area_is_needed(arguments):
    done = subprocess.run([sys.executable, "-m", "bench", *arguments], capture_output=True, text=True, check=False)
    assert done.returncode == 2
    for area in AREAS:
        assert area in done.stderr or not arguments


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
