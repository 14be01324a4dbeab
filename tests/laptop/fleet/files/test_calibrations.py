"""Calibrations go to robots with the config and come back, and a session on a robot is fitted and drawn here."""

import argparse
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from fake_releases import add_python, make_release
from fake_robots import FakeRobots, Run, outcomes
from needs import needs_ssh

from laptop.cli import calibrate as calibrate_by_ssh
from laptop.fleet.core import collect
from laptop.fleet.ssh.ssh import Ssh, hosts
from services.dwm.core.calibration import calibration_file
from services.dwm.core.calibration.calibration_file import CalibrationFile, Evidence, layout_of
from services.dwm.core.calibration.models import RangeModel
from services.dwm.core.calibration.samples import HEADER
from swarm.config import load
from swarm.errors import LocalError

pytest_plugins = ["fleet_fixtures"]
pytestmark = needs_ssh

INSTALL = """#!/bin/sh
echo "$@" >>$HOME/installed
for word; do case $word in */calibration) cat $word >$HOME/calibration ;; esac; done
echo "install: $(cat ID) runs as $2"
"""


def calibration(robot: str, gain: float, made: str, layout: str | None = None) -> str:
    evidence = Evidence("linear", made, 4, 9, "00", {}, 0.01, ())
    known = layout_of(()) if layout is None else layout
    return calibration_file.text_of(CalibrationFile(robot, known, (), (RangeModel(gain), evidence)))


@pytest.fixture
def here(robots: FakeRobots) -> Path:
    """Two robots, and where this computer keeps their calibrations."""
    for name in ("r0", "r1"):
        add_python(robots.add(name))
        robots.script(name, "sudo", 'shift; case $1 in cat) cat etc/${2#/etc/swarm/} ;; *) exec "$@" ;; esac')
    robots.config.write_text(robots.config.read_text() + '[dwm]\ncalibration = "calibration/{robot}.toml"\n')
    place = robots.folder / "calibration"
    place.mkdir()
    return place


def test_deploy_brings_each_robot_its_own_calibration_and_refuses_one_that_its_service_would(
    robots: FakeRobots, run: Run, here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (here / "r0.toml").write_text(calibration("r0", 0.95, "2026-01-01T00:00:00+00:00"))
    release = make_release(robots.folder / "a.tar.gz", "1-a", {}, INSTALL)
    assert run("deploy", str(release)) == 0
    assert (robots.folder / "r0/calibration").read_text() == (here / "r0.toml").read_text()
    assert not (robots.folder / "r1/calibration").exists()
    (here / "r1.toml").write_text(calibration("r1", 0.95, "2026-01-01T00:00:00+00:00", "0" * 16))
    assert run("deploy", str(release)) == 2
    assert "r1.toml: was made with other anchors" in capsys.readouterr().err
    (here / "r1.toml").write_text(calibration("r0", 0.95, "2026-01-01T00:00:00+00:00"))
    assert run("deploy", str(release)) == 2
    assert "is the calibration of r0, this is r1" in capsys.readouterr().err


def test_fetch_takes_a_newer_calibration_of_a_robot_and_leaves_a_newer_one_here(
    robots: FakeRobots, run: Run, here: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(collect, "RUNS", "runs")
    old = calibration("r0", 0.95, "2026-01-01T00:00:00+00:00")
    new = calibration("r0", 0.97, "2026-02-01T00:00:00+00:00")
    there = robots.folder / "r0/etc/calibration/r0.toml"
    there.parent.mkdir(parents=True)
    (robots.folder / "r0/runs").mkdir()
    there.write_text(new)
    (here / "r0.toml").write_text(old)
    fetch = ("fetch", "--into", str(robots.folder / "runs"), "--no-logs", "--json", "--robots", "r0")
    assert run(*fetch) == 0
    assert "calibration: " in str(outcomes(capsys)["r0"]["text"])
    assert (here / "r0.toml").read_text() == new
    assert (here / "r0.toml~").read_text() == old
    there.write_text(old)
    assert run(*fetch) == 0
    assert "is older than" in str(outcomes(capsys)["r0"]["text"])
    assert (here / "r0.toml").read_text() == new


def test_a_session_on_a_robot_is_led_from_here_and_fitted_here(robots: FakeRobots, here: Path) -> None:
    rows = [
        f"{k},{x},0.5,0.0,{k}.{i},D001,{1.05 * ((x * x + 0.25) ** 0.5) + 0.06},,"
        for k, x in enumerate((0.2, 0.8, 1.4, 2.0))
        for i in range(3)
    ]
    robots.config.write_text(robots.config.read_text() + '[[anchors]]\naddress = "D001"\nx = 0.0\ny = 0.0\n')
    (robots.folder / "samples").write_text("\n".join([HEADER, *rows]) + "\n")
    # The robot's own swarm leads a session: it answers the person's line, and leaves its samples where it was told to.
    session = f'echo "$*" >$HOME/asked; read line; echo "measuring after $line"; cp {robots.folder}/samples $HOME/s.csv'
    robots.script(
        "r0", "sudo", f"shift; case $1 in env) {session} ;; cat) cat $HOME/s.csv ;; rm) rm $HOME/s.csv ;; esac"
    )
    robots.ready()
    way = ["--config", str(robots.config), "--ssh-config", str(robots.ssh_config), "--robots", "r0"]
    done = subprocess.run(
        [sys.executable, "-m", "laptop.cli", "calibrate", "distance", "--places", "0.2,0.5 0.8,0.5", *way],
        input="start\n", capture_output=True, text=True, timeout=240, check=False, cwd=robots.folder,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "measuring after start" in done.stdout
    assert "swarm deploy brings it to the robot" in done.stdout
    asked = (robots.folder / "r0/asked").read_text()
    assert "swarm calibrate samples --robots r0 --places 0.2,0.5 0.8,0.5 --samples /run/swarm/calibration-r0-" in asked
    made = calibration_file.parse((here / "r0.toml").read_text(), "f")
    assert made.distance is not None
    assert made.distance[0].gain == pytest.approx(1 / 1.05)
    assert (here / "r0.png").read_bytes().startswith(b"\x89PNG")
    assert len(list(robots.folder.glob("calibration-r0-*.csv"))) == 1
    assert not (robots.folder / "r0/s.csv").exists()


def test_a_fit_of_samples_that_are_here_asks_no_robot(
    robots: FakeRobots, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Also where the configuration is named that the robots have."""
    monkeypatch.setenv("SWARM_CONFIG", "")
    words = ["fit", str(tmp_path / "none.csv"), "--robots", "r0", "--config", str(robots.config)]
    robots.add("r0")
    monkeypatch.setattr(sys, "argv", ["swarm", *words])
    with pytest.raises(LocalError, match=r"none\.csv: cannot be read"):
        calibrate_by_ssh.main()


def test_samples_stay_on_the_robot_until_they_are_on_the_disk_here(
    robots: FakeRobots, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    robots.add("r0")
    robots.script("r0", "sudo", "shift; case $1 in env) echo samples >$HOME/s.csv ;; cat | rm) $1 $HOME/s.csv ;; esac")
    robots.ready()
    config = load(robots.config)
    ssh, (host,) = Ssh(robots.ssh_config), hosts(config, ["r0"])
    monkeypatch.setattr(calibrate_by_ssh.calibrate, "places_of", lambda *_: [(0.2, 0.5)])
    options = argparse.Namespace(samples=tmp_path / "no folder/my.csv", orientations=1, count=1)
    with pytest.raises(LocalError, match="what was measured is on the robot until it is switched off, in /run/swarm/"):
        calibrate_by_ssh._measure(ssh, host, options, config)
    assert (robots.folder / "r0/s.csv").exists()
    options.samples = tmp_path / "my.csv"
    assert calibrate_by_ssh._measure(ssh, host, options, config).read_text() == "samples\n"
    assert not (robots.folder / "r0/s.csv").exists()


def test_what_was_measured_before_ctrl_c_is_brought_here(robots: FakeRobots, here: Path) -> None:
    measured = "echo samples >$HOME/s.csv; echo measuring; read line"
    robots.script(
        "r0", "sudo", f"shift; case $1 in env) {measured} ;; cat) cat $HOME/s.csv ;; rm) rm $HOME/s.csv ;; esac"
    )
    robots.ready()
    way = ["--config", str(robots.config), "--ssh-config", str(robots.ssh_config), "--robots", "r0"]
    command = [
        sys.executable,
        "-m",
        "laptop.cli",
        "calibrate",
        "distance",
        "--places",
        "0.2,0.5",
        "--samples",
        "my.csv",
    ]
    pipe = subprocess.PIPE
    with subprocess.Popen([*command, *way], stdin=pipe, stdout=pipe, stderr=pipe, text=True, cwd=robots.folder) as led:
        assert led.stdout is not None
        assert led.stdout.readline() == "measuring\n"
        led.send_signal(signal.SIGINT)
        _, errors = led.communicate(timeout=240)
    assert errors == "swarm: r0: the session was interrupted; what was measured is in my.csv\n"
    assert (robots.folder / "my.csv").read_text() == "samples\n"
    assert not (robots.folder / "r0/s.csv").exists()


@pytest.mark.parametrize("words", ["fit my.csv", "offset my.csv", "check --samples my.csv"])
def test_what_is_in_files_is_read_here_also_where_a_swarm_is_named(
    robots: FakeRobots, run: Run, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], words: str
) -> None:
    robots.add("r0")
    robots.script("r0", "sudo", "touch $HOME/asked")
    monkeypatch.chdir(robots.folder)
    Path("my.csv").write_text("no samples")
    assert run("calibrate", *words.split(), "--robots", "r0") == 2
    assert "my.csv:" in capsys.readouterr().err
    assert not (robots.folder / "r0/asked").exists()


def test_samples_alone_are_brought_here_and_none_are_written_over(
    robots: FakeRobots, run: Run, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    robots.add("r0")
    robots.script("r0", "sudo", "shift; case $1 in env) echo samples >$HOME/s.csv ;; cat | rm) $1 $HOME/s.csv ;; esac")
    monkeypatch.chdir(robots.folder)
    words = ("calibrate", "samples", "--robots", "r0", "--places", "0.2,0.5", "--samples", "my.csv")
    assert run(*words) == 0
    assert "the samples are in my.csv: swarm calibrate fit my.csv --robots r0" in capsys.readouterr().out
    Path("my.csv").write_text("an hour's work")
    for command in ("samples", "distance", "position"):
        assert run("calibrate", command, *words[2:]) == 2
        assert "my.csv: is there already" in capsys.readouterr().err
    assert Path("my.csv").read_text() == "an hour's work"


def test_where_nothing_was_measured_no_samples_are_promised(
    robots: FakeRobots, run: Run, capsys: pytest.CaptureFixture[str]
) -> None:
    robots.add("r0")
    robots.script("r0", "sudo", "shift; case $1 in env) exit 2 ;; cat) cat $HOME/s.csv ;; esac")
    words = ("calibrate", "distance", "--robots", "r0", "--places", "0.2,0.5")
    assert run(*words) == 2
    assert capsys.readouterr().err == "swarm: r0: the session ended with code 2; nothing was measured\n"
    robots.close()
    assert run(*words) == 2
    error = capsys.readouterr().err
    assert "measured" not in error, error
