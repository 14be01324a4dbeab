"""`swarm measure radio` on robots: which runs they make, and the commands that make them."""

import argparse
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from fake_releases import PATHS, add_python, add_robot, make_package_cache
from fake_robots import FakeRobots
from needs import needs_ssh

from laptop.cli.measure import experiments
from laptop.cli.measure.experiments import Laboratory, config_of
from services.mesh.core.routing.physical_links import callers, physical, piconets
from sim.virtual.run import run_virtually
from swarm.config import Config, load, parse
from swarm.config.dump import dump
from swarm.config.example import EXAMPLE
from swarm.errors import LocalError

pytest_plugins = ["fleet_fixtures"]

ROOT = Path(__file__).parents[4]
ROBOTS = "".join(f'[[robots]]\nname = "r{n}"\nbluetooth = "B8:27:EB:00:00:1{n}"\n' for n in range(4))
ODD = f"""network = "test"
{ROBOTS}[topology]
shape = "line"
[body.robots.r3]
wheel_radius = 0.041
[simulation.places]
r3 = [1.0, 1.0, 0.0]
[apps.consensus]
value = 3.0
[apps.consensus.robots.r3]
value = 4.0
"""


def busiest(config: Config) -> int:
    links = physical(config.names, config.edges, config.mesh.links)
    return max(piconets(callers(config.names, config.edges) if config.mesh.links == "graph" else links).values())


def test_the_experiments_have_robots_in_one_and_in_two_piconets() -> None:
    config = parse(EXAMPLE, Path("swarm.toml"))
    planned = experiments.experiments(6)
    assert [each.name for each in planned] == ["line-3", "loop-3", "star-6", "loop-6"]
    assert [busiest(config_of(config, each)) for each in planned] == [1, 2, 1, 2]
    assert [each.name for each in experiments.experiments(3)] == ["line-3", "loop-3"]
    assert experiments.experiments(20)[-1].name == "loop-8"
    with pytest.raises(LocalError, match="need 3 robots, the configuration has 2"):
        experiments.experiments(2)


def test_the_configuration_of_an_experiment_is_one_that_robots_accept(tmp_path: Path) -> None:
    config = parse(ODD, tmp_path / "swarm.toml")
    for experiment in experiments.experiments(4):
        found = parse(dump(config_of(config, experiment)), tmp_path / "other.toml")
        assert found.names == config.names[: experiment.robots]
        assert found.mesh.links == experiment.links
        assert len(found.edges) == experiment.robots - (experiment.shape == "line")
        assert "consensus" not in found.apps
        assert ("r3" in found.bodies) == (experiment.robots == 4)


class Commands:
    """In place of processes of `swarm`: notes each command line, and answers it."""

    def __init__(self, *phases: str) -> None:
        self.lines: list[str] = []
        self._phases = list(phases)

    def __call__(self, process: list[str], **_: object) -> subprocess.CompletedProcess[str]:
        words = process[process.index("laptop.cli") + 1 :]
        if words[0] != "status":
            self.lines.append(" ".join(words[: words.index("--config") + 2]))
        said = "r0  swarm-app@consensus.service runs: consensus-00ab" if words[0] == "run" else ""
        if words[0] == "status":
            phase = self._phases.pop(0)
            apps = {"consensus": {"phase": phase, "k": 1}}
            said = json.dumps(
                {"robots": {"r0": {"apps": apps}, "r1": {"problem": "x"} if phase == "" else {"apps": apps}}}
            )
            if phase == "error":
                return subprocess.CompletedProcess(process, 2, "")
        return subprocess.CompletedProcess(process, int(words[0] == "status"), said)


def laboratory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, commands: Commands) -> Laboratory:
    monkeypatch.setattr(experiments.subprocess, "run", commands)
    monkeypatch.setattr(experiments, "LOOK_EVERY_S", 0.0)
    (tmp_path / "swarm.toml").write_text(ODD)
    args = argparse.Namespace(into=tmp_path / "radio", iterations=40, ssh_config=None)
    return Laboratory(args, load(tmp_path / "swarm.toml"))


def test_robots_that_take_no_part_are_silent_and_all_get_their_configuration_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    commands = Commands("running", "", *["done"] * 4)
    folder = tmp_path / "radio"
    found = laboratory(tmp_path, monkeypatch, commands).go()
    names = ("line-3", "loop-3", "star-4", "loop-4")
    assert found == [folder / name / "consensus-00ab" for name in names]
    own = f"--config {tmp_path / 'swarm.toml'}"
    lines = []
    for name in names:
        lines += [f"services stop mesh --robots r3 {own}"] if name.endswith("3") else []
        lines += [
            f"deploy --config {folder / name}.toml",
            f"run consensus --iterations 40 --config {folder / name}.toml",
            f"fetch consensus-00ab --no-logs --into {folder / name} --config {folder / name}.toml",
        ]
    assert commands.lines == [*lines, f"deploy {own}"]


def test_a_run_that_fails_is_named_and_robots_get_their_configuration_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    commands = Commands("running", "fault")
    with pytest.raises(LocalError, match=r"not ended on all robots: r0 fault, r1 fault; swarm logs consensus --config"):
        laboratory(tmp_path, monkeypatch, commands).go()
    assert commands.lines[-1] == f"deploy --config {tmp_path / 'swarm.toml'}"
    with pytest.raises(LocalError, match=r"swarm status --json .*has failed"):
        laboratory(tmp_path, monkeypatch, Commands("running", "error")).go()
    monkeypatch.setattr(experiments, "PATIENCE_S", 0.0)
    with pytest.raises(LocalError, match="not ended on all robots: r0 running, r1 running"):
        laboratory(tmp_path, monkeypatch, Commands("running")).go()


def test_a_second_interrupt_says_how_robots_get_their_configuration_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupt(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    there = laboratory(tmp_path, monkeypatch, Commands())
    monkeypatch.setattr(experiments.subprocess, "run", interrupt)
    with pytest.raises(KeyboardInterrupt):
        there.go()
    said = "robots may still have an experiment's configuration, or no mesh: swarm deploy --config"
    assert f"{said} {tmp_path / 'swarm.toml'}\n" in capsys.readouterr().err


RESTART = """case "$1 $*" in restart*swarm-app@consensus*)
    run=$(sed -n 's/.*--run \\([0-9a-f]*\\).*/\\1/p' $HOME/etc/apps/consensus.env)
    edges=$(grep -c '^ *"r[0-9]",$' $HOME/config)
    mkdir -p $HOME/lib/runs/consensus-$run
    cp {recorded}/$edges/* $HOME/lib/runs/consensus-$run
esac
"""
"""What a robot's app does: its recording is that of a simulation over the same links."""

SUDO = """shift
case "$1 $2" in
    ./install*) cp $5 $HOME/config; echo "install: $(cat ID) runs as $3" ;;
    *z_sub*\\**) echo '{progress}' ;;
    *z_sub*) ;;
    *) for word; do shift; set -- "$@" "$(printf '%s\\n' "$word" | sed '{paths}')"; done; exec "$@" ;;
esac
"""
"""A robot's commands, with the system's folders in its home."""

RECORDED = {"line-3": "4", "loop-3": "6"}
"""The experiments of three robots, and how many lines with a robot's name their configuration has."""


@needs_ssh
@pytest.mark.slow
@pytest.mark.timeout(300)
def test_three_robots_make_their_runs_over_ssh_and_the_report_finds_their_radio(robots: FakeRobots) -> None:
    """The robots' systemd and apps are doubles; deploying, starting, asking and fetching are not."""
    for name, edges in RECORDED.items():
        run_virtually(
            "consensus", "--robots", "3", "--topology", name.removesuffix("-3"), "--links", "graph",
            "--radio", "slots:stay=0.2,host=0.004", "--iterations", "60", "--seed", "5",
            "--record", str(robots.folder / "recorded" / edges),
        )  # fmt: skip
    for name in ("r0", "r1", "r2"):
        home = add_robot(robots, name)
        add_python(home)
        robots.script(name, "sha256sum", 'case $1 in /etc/*) set -- $HOME/config ;; esac; exec /usr/bin/sha256sum "$@"')
        progress = {"key": f"swarm/{name}/app/consensus/progress"}
        progress |= {"value": {"t": 1.0, "phase": "done", "k": 60, "waiting_for": [], "reason": ""}}  # type: ignore[dict-item]
        robots.script(name, "sudo", SUDO.format(progress=json.dumps(progress), paths=PATHS))
        systemctl = (home / "bin/systemctl").read_text()
        restart = RESTART.format(recorded=robots.folder / "recorded")
        (home / "bin/systemctl").write_text(
            systemctl.replace("\ncase $1 in list-units", f"\n{restart}case $1 in list-units")
        )
    robots.ready()
    make_package_cache(robots.folder / "cache")
    environment = {name: value for name, value in os.environ.items() if not name.startswith("SWARM_")}
    environment |= {"PYTHONPATH": str(ROOT), "XDG_CACHE_HOME": str(robots.folder / "cache")}
    words = ["measure", "radio", "--config", str(robots.config), "--ssh-config", str(robots.ssh_config)]
    done = subprocess.run(
        [sys.executable, "-P", "-m", "laptop.cli", *words], check=False, capture_output=True, text=True,
        cwd=robots.folder, env=environment, timeout=280,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    assert "simulate this radio with: --radio slots:host=0.00" in done.stdout
    assert (robots.folder / "radio/report.txt").read_text() == done.stdout
    found = {
        path.parent.parent.name: path.read_bytes() for path in (robots.folder / "radio").glob("*/consensus-*/*.mcap")
    }
    recorded = robots.folder / "recorded"
    assert found == {name: next((recorded / edges).glob("*.mcap")).read_bytes() for name, edges in RECORDED.items()}
    for name in ("r0", "r1", "r2"):
        assert (robots.folder / name / "config").read_bytes() == robots.config.read_bytes()
