"""What looks at robots or acts on them does so in a simulation, on one real robot and on all of them."""

import contextlib
import io
import json
import re
import subprocess
import sys
from pathlib import Path

import pytest
from conftest import wait_until
from fake_robots import FakeRobots, Run
from needs import needs_ssh

from bench.rigs.running import running
from laptop.cli import main
from laptop.cli.commands import SECTIONS
from swarm.onboard.command_line import Command, CommandGroup, commands_of

pytest_plugins = ["fleet_fixtures"]

EVERYWHERE = (
    "status", "logs", "mesh show", "mesh topology show", "mesh epoch show", "measure rtt", "measure throughput",
    "measure rssi", "measure i2c", "dwm info", "dwm check", "app start", "app stop", "app param", "balance stand",
    "services start", "services stop", "services restart",
)  # fmt: skip


def helped(words: list[str]) -> str:
    out = io.StringIO()
    with contextlib.redirect_stdout(out), pytest.raises(SystemExit):
        main([*words, "--help"])
    return out.getvalue()


@pytest.mark.parametrize("name", EVERYWHERE)
def test_a_command_names_robots_of_a_simulation_and_real_ones(name: str) -> None:
    text = helped(name.split())
    assert "--robots" in text
    assert "--run-dir" in text
    command = commands_of(SECTIONS)[name.split()[0]]
    if isinstance(command, CommandGroup):
        command = command.commands[name.split()[1]]
    assert isinstance(command, Command)
    assert command.far or "--ssh-config" in text


@pytest.mark.parametrize("words", ["status", "services restart mesh", "app param consensus", "balance rest", "mesh"])
def test_a_command_that_names_a_simulation_and_real_robots_is_refused(
    words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as end:
        main([*words.split(), "--run-dir", str(tmp_path), "--real"])
    assert end.value.code == 2
    assert "--run-dir means a simulation, and --real," in capsys.readouterr().err


SUDO = 'echo "$*" >>$HOME/asked; echo "line of $HOME" | sed s#$HOME/*#robot#; [ ! -e $HOME/bad ] || exit 1'
THERE = "-n env SWARM_ROBOT={} SWARM_RUNTIME=/run/swarm /opt/swarm/current/bin/swarm "


@needs_ssh
@pytest.mark.parametrize(
    ("words", "asked"),
    [
        ("mesh show", {"r0": "mesh show", "r1": "mesh show"}),
        ("mesh topology set loop", {"r0": "mesh topology set loop"}),
        ("mesh epoch consensus --robots r1", {"r1": "mesh epoch consensus"}),
        ("measure rtt r1 r0 --count 3", {"r1": "measure rtt r1 r0 --count 3"}),
        ("measure i2c --robots r0", {"r0": "measure i2c"}),
        ("measure i2c r1 --sizes 4", {"r1": "measure i2c --sizes 4"}),
        ("measure rssi r1 r0", {"r1": "measure rssi r1 r0"}),
        ("dwm check", {"r0": "dwm check", "r1": "dwm check"}),
    ],
)
def test_a_command_for_real_robots_is_run_by_those_that_are_meant(
    robots: FakeRobots, run: Run, words: str, asked: dict[str, str]
) -> None:
    for name in ("r0", "r1"):
        robots.add(name)
        robots.script(name, "sudo", SUDO)
    assert run(*words.split()) == 0
    found = {path.parent.name: path.read_text() for path in robots.folder.glob("*/asked")}
    assert found == {name: f"{THERE.format(name)}{command}\n" for name, command in asked.items()}


@needs_ssh
@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("measure i2c r9", "r9 is no robot of .*; there are r0, r1"),
        ("measure i2c r0 r9 --sizes 4", "r9 is no robot of .*; there are r0, r1"),
        ("measure i2c r0 --robots r1", "name the robots by --robots or as arguments, not by both"),
        ("measure i2c --sizes 99", "a whole number from 1 to 28"),
    ],
)
def test_a_measurement_of_robots_that_cannot_be_meant_asks_none(
    robots: FakeRobots, run: Run, capsys: pytest.CaptureFixture[str], words: str, said: str
) -> None:
    for name in ("r0", "r1"):
        robots.add(name, up=False)
    assert run(*words.split()) == 2
    assert re.search(said, capsys.readouterr().err)


@needs_ssh
def test_answers_of_real_robots_are_told_apart_and_an_absent_one_is_named(
    robots: FakeRobots, run: Run, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("r0", "r1"):
        robots.add(name)
        robots.script(
            name, "sudo", """case "$*" in *--json) echo '{"links": 3}' ;; *) echo three; echo links ;; esac"""
        )
    robots.add("r2", up=False)
    assert run("mesh", "show") == 1
    assert capsys.readouterr().out.splitlines() == [
        "[r0] three", "[r0] links", "[r1] three", "[r1] links", "r2: it runs no ssh server (or another port)",
    ]  # fmt: skip
    assert run("mesh", "show", "--robots", "r1") == 0
    assert capsys.readouterr().out.splitlines() == ["three", "links"]
    assert run("mesh", "show", "--json", "--robots", "r0,r1") == 0
    assert json.loads(capsys.readouterr().out) == {"robots": {"r0": {"links": 3}, "r1": {"links": 3}}}


@needs_ssh
def test_an_answer_that_is_no_json_costs_no_other_robots_answer(
    robots: FakeRobots, run: Run, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("r0", "r1"):
        robots.add(name)
        robots.script(name, "sudo", f"[ {name} = r0 ] || echo Welcome; echo '{{\"links\": 3}}'")
    assert run("mesh", "show", "--json") == 1
    found = json.loads(capsys.readouterr().out)["robots"]
    assert found["r0"] == {"links": 3}
    assert found["r1"]["problem"].startswith("its answer cannot be understood")


@needs_ssh
def test_an_app_of_real_robots_is_started_and_stopped_as_one_of_a_simulation(robots: FakeRobots, run: Run) -> None:
    home = robots.add("r0")
    assert run("app", "start", "consensus") == 0
    assert run("app", "stop", "consensus", "r0") == 0
    said = ["start --no-block swarm-app@consensus.service", "stop swarm-app@consensus.service"]
    assert (home / "systemctl.log").read_text().splitlines() == said


@pytest.mark.slow
def test_status_logs_services_and_apps_of_a_simulation(runtime: Path) -> None:
    def swarm(*words: str) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-m", "laptop.cli", *words, "--run-dir", str(runtime / "run")]
        return subprocess.run(command, capture_output=True, text=True, timeout=240, check=False)

    words = ["sim", "consensus", "--robots", "2", "--seconds", "100", "--run-dir", str(runtime / "run")]
    with running([sys.executable, "-m", "laptop.cli", *words], stdout=subprocess.DEVNULL):
        wait_until(lambda: swarm("status", "--json").returncode == 0, what="both robots answer")
        rows = json.loads(swarm("status", "--json").stdout)["robots"]
        assert sorted(rows) == ["r0", "r1"]
        assert rows["r0"]["release"] == "simulated"
        said = swarm("logs", "mesh", "--robots", "r1", "-n", "50").stdout
        assert "link up peer=r0" in said
        assert all(line.startswith("r1: ") for line in said.splitlines())
        assert swarm("services", "restart", "--robots", "r0", "dwm").stdout == "r0: restart dwm\n"
        refused = swarm("services", "stop", "dwm")
        assert refused.returncode == 2
        assert "a simulation runs every service: restart dwm" in refused.stderr
        assert swarm("services", "stop", "consensus").returncode == 0
