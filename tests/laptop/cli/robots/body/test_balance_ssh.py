"""`swarm balance` by ssh: each robot's own command, and what the laptop says of its answer."""

import json
from pathlib import Path

import pytest
from fake_robots import FakeRobots, Run, outcomes
from needs import needs_ssh

pytest_plugins = ["fleet_fixtures"]
pytestmark = needs_ssh


def add(robots: FakeRobots, name: str, said: str) -> Path:
    home = robots.add(name)
    robots.script(name, "sudo", f"shift; printf '%s\\n' \"$*\" > asked; echo '{said}'")
    return home


def test_each_robot_runs_its_own_command(robots: FakeRobots, run: Run, capsys: pytest.CaptureFixture[str]) -> None:
    row = {"ok": True, "text": "stands"}
    home = add(robots, "r0", json.dumps({"mode": "stand", "robots": {"r0": row}}))
    refused = {"ok": False, "text": "stopped: test: take the stop back (swarm arm), then swarm balance stand"}
    add(robots, "r1", json.dumps({"mode": "stand", "robots": {"r1": refused}}))
    add(robots, "r2", "[]")
    assert run("balance", "stand", "--robots", "r0") == 0
    assert "stands" in capsys.readouterr().out
    asked = (home / "asked").read_text()
    assert asked.startswith("env SWARM_ROBOT=r0 SWARM_RUNTIME=/run/swarm ")
    assert asked.endswith("/opt/swarm/current/bin/swarm balance stand --json --timeout 40.0\n")
    assert run("balance", "stand", "--json") == 1
    found = outcomes(capsys)
    assert {name: each["ok"] for name, each in found.items()} == {"r0": True, "r1": False, "r2": False}
    assert found["r1"]["text"] == refused["text"]
    assert "no answer" in str(found["r2"]["text"])
