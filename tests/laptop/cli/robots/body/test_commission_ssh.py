"""`swarm commission` by ssh: the robot's own command leads, the laptop shows its lines and keeps its report."""

import json
from pathlib import Path

import pytest
from fake_robots import FakeRobots, Run
from needs import needs_ssh

pytest_plugins = ["fleet_fixtures"]
pytestmark = needs_ssh

REPORT = {"report": 1, "robot": "r0", "date": "2026-11-23T14:00:00Z", "release": "x", "verdict": "passed", "steps": []}


def test_the_report_of_a_real_robot_is_kept_on_the_laptop(
    robots: FakeRobots, run: Run, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    lines = [{"say": "step 1 of 1: all"}, {"say": "Lay it down.", "ask": "lay-back"}, {"report": REPORT}]
    robots.add("r0")
    robots.script("r0", "sudo", 'echo "$@" > asked; ' + "".join(f"echo '{json.dumps(line)}'; " for line in lines))
    out = tmp_path / "report.json"
    assert run("commission", "r0", "--out", str(out)) == 0
    assert json.loads(out.read_text()) == REPORT
    said = capsys.readouterr().out.splitlines()
    assert said[:2] == ["step 1 of 1: all", "  ? Lay it down."]
    assert said[-1] == f"r0: passed; report: {out}"
    assert (tmp_path / "r0" / "asked").read_text().strip().endswith("/opt/swarm/current/bin/swarm commission --json")


def test_a_connection_that_breaks_leaves_the_report_of_the_steps_until_then(
    robots: FakeRobots, run: Run, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    rows = [{"name": "ready", "verdict": "passed"}, {"name": "bus", "verdict": "not tried"}]
    so_far = REPORT | {"verdict": "failed", "steps": rows}
    robots.add("r0")
    robots.script("r0", "sudo", f"echo '{json.dumps({'so_far': so_far})}'; exit 255")
    out = tmp_path / "report.json"
    assert run("commission", "r0", "--out", str(out)) == 1
    ended = "r0: the connection is lost; the robot stops by itself"
    assert json.loads(out.read_text()) == so_far | {"ended": ended}
    assert capsys.readouterr().out.splitlines() == [
        "ready      passed", "bus        not tried", ended, f"r0: failed; report: {out}"
    ]  # fmt: skip


def test_a_report_that_could_not_be_written_is_refused_before_the_work_and_shown_after_it(
    robots: FakeRobots, run: Run, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    robots.add("r0")
    robots.script("r0", "sudo", f"touch asked; mkdir {tmp_path}/out; echo '{json.dumps({'report': REPORT})}'")
    assert run("commission", "r0", "--out", str(tmp_path / "none/report.json")) == 2
    assert "expected a file in a folder that is there" in capsys.readouterr().err
    assert not (tmp_path / "r0/asked").exists()
    assert run("commission", "r0", "--out", str(tmp_path / "out")) == 2
    shown = capsys.readouterr()
    assert json.loads(shown.out) == REPORT
    assert "out: Is a directory; the report is the line above, keep it in a file" in shown.err


def test_a_command_that_ends_before_any_step_leaves_no_report(
    robots: FakeRobots, run: Run, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    robots.add("r0")
    robots.script("r0", "sudo", 'echo \'{"say": "step"}\'; exit 3')
    out = tmp_path / "report.json"
    assert run("commission", "r0", "--out", str(out)) == 2
    assert "ended without a report (exit code 3)" in capsys.readouterr().err
    assert not out.exists()
