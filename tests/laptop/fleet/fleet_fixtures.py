"""Robots that are ssh servers, and the command line that speaks to them.

A plugin that the tests name: a second `conftest` would hide the one that other tests import from.
"""

from collections.abc import Iterator
from pathlib import Path

import pytest
from fake_robots import FakeRobots, Run

from laptop.cli import main


@pytest.fixture
def robots(tmp_path: Path) -> Iterator[FakeRobots]:
    robots = FakeRobots(tmp_path)
    yield robots
    robots.close()


@pytest.fixture
def run(robots: FakeRobots) -> Run:
    def swarm(verb: str, *arguments: str) -> int:
        robots.ready()
        with pytest.raises(SystemExit) as end:
            main([verb, *arguments, "--config", str(robots.config), "--ssh-config", str(robots.ssh_config)])
        return int(str(end.value.code))

    return swarm
