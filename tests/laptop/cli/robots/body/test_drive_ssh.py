"""`swarm drive` by ssh: the keys reach the robot's own command, and its lines come back."""

import argparse
import os

import pytest
from fake_robots import FakeRobots, Run
from needs import needs_ssh

from laptop.cli import halt

pytest_plugins = ["fleet_fixtures"]
pytestmark = needs_ssh


def test_keys_go_to_the_robots_own_command(
    robots: FakeRobots, run: Run, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    home = robots.add("r0")
    robots.script("r0", "sudo", 'shift; echo "$@" > asked; echo "r0: keys"; cat > typed; exit 1')
    robots.add("r1", up=False)
    read, write = os.pipe()
    os.write(write, b"ww x")
    os.close(write)
    saved = os.dup(0)
    os.dup2(read, 0)
    try:
        with os.fdopen(read) as stream:
            monkeypatch.setattr("sys.stdin", stream)
            assert run("drive", "r0") == 1
            assert capsys.readouterr().out == "r0: keys\n"
            assert run("drive", "r1") == 2
            assert "r1: ssh does not get through to it" in capsys.readouterr().err
    finally:
        os.dup2(saved, 0)
        os.close(saved)
    assert (home / "typed").read_text() == "ww x"
    assert (home / "asked").read_text().endswith("/opt/swarm/current/bin/swarm drive\n")


@pytest.mark.parametrize("command", ["drive", "commission"])
def test_a_robot_without_a_release_says_what_it_needs(
    robots: FakeRobots, run: Run, capsys: pytest.CaptureFixture[str], command: str
) -> None:
    robots.add("r0")
    assert run(command, "r0") == 2
    assert "swarm: r0: Balboa Swarm is not installed on it: swarm deploy\n" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("command", "line"),
    [("drive", "r0: stop"), ("commission", '{"say": "stopped by the person: swarm arm takes the stop back"}')],
)
def test_a_stop_by_the_space_bar_is_given_to_all_robots_as_by_estop(
    robots: FakeRobots, run: Run, monkeypatch: pytest.MonkeyPatch, command: str, line: str
) -> None:
    """The robot's own command gives it on that robot's bus alone, and its mesh may not reach the others."""
    given: list[argparse.Namespace] = []
    monkeypatch.setattr(halt, "run", given.append)
    robots.add("r0")
    robots.add("r1")
    robots.script("r0", "sudo", f"echo 'r0: go on'; echo '{line}'; exit 1")
    run(command, "r0")
    (estop,) = given
    assert (estop.act, estop.reason, estop.robots) == ("stop", f"swarm {command}", None)
    assert estop.config == robots.config
