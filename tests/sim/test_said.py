"""What apps print and log is seen: live, by robot, and in the recording."""

import argparse
import sys
from pathlib import Path

import pytest

from laptop.cli.robots import logs
from services.apps.equipment.speaker import MOST_LINES_S, Speaker
from sim.scenario.options import parse
from sim.scenario.scenario import build
from sim.virtual.run import PLACE, VirtualRun, run_virtually
from swarm.app.robot import Robot
from swarm.core.graph import Graph
from swarm.errors import LocalError
from swarm.messages import AppLog
from swarm.process.simulations import claim
from swarm.recording.reader import SUFFIX

TALKS = """
from swarm import {kind}

class Talks({kind}):
    n: int

    def start(self):
        print("hello", end=" ")
        print("there")

    def step(self, neighbours):
        self.n += 1
        if self.n == 3:
            self.robot.log.warning("three is %d", self.n)
        if self.n == 4:
            print("two\\nlines")
        if self.n == 6:
            print("the end", end="")
"""


def write(place: Path, kind: str) -> str:
    (place / "talks.py").write_text(TALKS.format(kind=kind))
    return str(place / "talks.py")


@pytest.mark.parametrize("kind", ["SyncApp", "PeriodicApp"])
def test_every_line_comes_with_its_robot_and_is_recorded(
    tmp_path: Path, kind: str, capsys: pytest.CaptureFixture[str]
) -> None:
    heard: list[tuple[str, str, str]] = []
    words = ["--robots", "2", "--iterations", "6", "--virtual", "--record"]
    options = parse([write(tmp_path, kind), *words, str(tmp_path / "run")])
    (tmp_path / "run").mkdir()
    before = sys.stdout
    VirtualRun(
        options, build(options, PLACE), said=lambda robot, line: heard.append((robot, line.level, line.text))
    ).go()
    assert sys.stdout is before
    lines = [
        ("print", "hello there"),
        ("warning", "three is 3"),
        ("print", "two"),
        ("print", "lines"),
        ("print", "the end"),
    ]
    for robot in ("r0", "r1"):
        assert [(level, text) for who, level, text in heard if who == robot] == lines
    assert capsys.readouterr().out == ""
    parser = argparse.ArgumentParser()
    logs.add_arguments(parser)
    assert logs.run(parser.parse_args([str(tmp_path / "run"), "--robots", "r1"])) == 0
    printed = capsys.readouterr().out.splitlines()
    assert [line.partition("r1  ")[2] for line in printed] == [
        "hello there",
        "warning: three is 3",
        "two",
        "lines",
        "the end",
    ]


def test_an_unfinished_line_is_lost_with_its_process(tmp_path: Path) -> None:
    path = tmp_path / "dots.py"
    path.write_text(
        "from swarm import PeriodicApp\nclass Dots(PeriodicApp):\n    n: int\n    period = 1.0\n"
        "    def step(self, neighbours):\n        self.n += 1\n"
        "        print(f'.{self.n}', end='\\n' if self.n == 4 else '')\n"
    )
    heard: list[str] = []
    options = parse([str(path), "--robots", "1", "--seconds", "8.5", "--kill", "r0.app@2.5s", "--virtual"])
    VirtualRun(options, build(options, PLACE), said=lambda _, line: heard.append(line.text)).go()
    assert heard == [".1.2.3.4", ".5.6"]


def test_of_a_run_the_last_lines_of_each_robot_and_of_the_apps_that_are_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, run = tmp_path / "talks.py", str(tmp_path / "run")
    path.write_text(TALKS.format(kind="SyncApp"))
    run_virtually(str(path), "consensus", "--robots", "2", "--iterations", "6", "--record", run)
    parser = argparse.ArgumentParser()
    logs.add_arguments(parser)

    def printed(*words: str) -> list[str]:
        assert logs.run(parser.parse_args([run, *words])) == 0
        return [line.rpartition(" s  ")[2] for line in capsys.readouterr().out.splitlines()]

    assert sorted(printed("-n", "1")) == ["r0  the end", "r1  the end"]
    assert len(printed("talks")) == len(printed()) == 10
    assert printed("consensus") == ["no app has printed or logged anything in this run"]
    with pytest.raises(LocalError, match="no app nosuch is recorded; there are: consensus, talks"):
        logs.run(parser.parse_args([run, "nosuch"]))
    with pytest.raises(LocalError, match="r1 is a robot, and not an app: name robots by --robots r1"):
        logs.run(parser.parse_args([run, "r1"]))
    with pytest.raises(LocalError, match="nothing new comes"):
        logs.run(parser.parse_args([run, "-f"]))


def test_a_run_that_is_not_there_is_no_service_of_robots() -> None:
    parser = argparse.ArgumentParser()
    logs.add_arguments(parser)
    with pytest.raises(LocalError, match="runs/none: there is no such run"):
        logs.run(parser.parse_args(["runs/none"]))


def test_a_name_that_is_nothing_here_names_the_runs_that_are(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run_virtually("consensus", "--robots", "2", "--iterations", "3", "--record", str(tmp_path / "runs" / "first"))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(logs, "find", lambda: None)
    parser = argparse.ArgumentParser()
    logs.add_arguments(parser)
    for name, there in (("firts", "runs/first"), ("runs/firts", "runs/first")):
        with pytest.raises(LocalError, match=rf"{name}: there is no such run.*; there are: {there}"):
            logs.run(parser.parse_args([name]))
    with pytest.raises(
        LocalError, match=r"may also be that of a service or app .*, where a swarm.toml names the robots"
    ):
        logs.run(parser.parse_args(["firts"]))


def test_logs_beside_a_simulation_say_when_there_is_nothing_and_refuse_a_name_that_no_robot_has(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    parser = argparse.ArgumentParser()
    logs.add_arguments(parser)
    with claim(tmp_path / "run"):
        with pytest.raises(LocalError, match="has no robots at this moment"):
            logs.run(parser.parse_args(["--run-dir", str(tmp_path / "run")]))
        (tmp_path / "run" / "swarm.toml").write_text('robots = [{ name = "r0" }]')
        (tmp_path / "run" / "r0").mkdir()
        for name, text in (("mesh.log", "link up\n"), ("app.talks.log", "")):
            (tmp_path / "run" / "r0" / name).write_text(text)
        monkeypatch.chdir(tmp_path)
        (tmp_path / "talks").mkdir()  # as that of the app's source
        (tmp_path / "mesh").mkdir()
        (tmp_path / "mesh" / f"r0.talks{SUFFIX}").touch()
        for name, line in (("mesh", "r0: link up"), ("talks", "nothing is logged yet by talks of r0")):
            assert logs.run(parser.parse_args([name, "--run-dir", str(tmp_path / "run")])) == 0
            assert capsys.readouterr().out == f"{line}\n"
        with pytest.raises(LocalError, match=r"walks: no robot of the simulation .*; there are: mesh, talks"):
            logs.run(parser.parse_args(["walks", "--run-dir", str(tmp_path / "run")]))


def test_a_sweep_is_not_flooded_by_what_apps_print(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run_virtually(write(tmp_path, "SyncApp"), "--robots", "2", "--iterations", "6")
    assert capsys.readouterr().out == ""


def test_an_app_that_never_stops_talking_is_cut_short_and_says_so() -> None:
    now = 0.0
    robot = Robot("r0", Graph(("r0",), ()), app="talks", time=lambda: now)
    told: list[AppLog] = []

    class Bus:
        def publish(self, key: str, message: object, *, urgent: bool = False) -> None:
            assert key == "swarm/r0/app/talks/log"

    speaker = Speaker(robot, Bus(), told.append)  # type: ignore[arg-type]
    for _ in range(2 * MOST_LINES_S):
        speaker("info", "again \x1b[2J")
    assert len(told) == MOST_LINES_S + 1
    assert told[-1].text == "more than 100 lines within a second: the others of this second are left out"
    assert "\x1b" not in told[0].text
    now = 1.0
    speaker("info", "later")
    assert [line.text for line in told[MOST_LINES_S + 1 :]] == ["later"]
