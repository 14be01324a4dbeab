"""`swarm drive` by ssh: the keys reach the robot's own command, and its lines come back."""

import os

import pytest
from fake_robots import FakeRobots, Run
from needs import needs_ssh

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
            assert "the robot stops by itself" in capsys.readouterr().err
    finally:
        os.dup2(saved, 0)
        os.close(saved)
    assert (home / "typed").read_text() == "ww x"
    assert (home / "asked").read_text().endswith("/opt/swarm/current/bin/swarm drive\n")
