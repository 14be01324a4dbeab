"""Robots that are a real OpenSSH server each (bench/fake_robots.py), for tests."""

import json
import os
import shutil
from collections.abc import Callable

import pytest

from bench.fake_robots import SSHD, FakeRobots, free_port

__all__ = ["SSHD", "FakeRobots", "Run", "free_port", "needs_ssh", "outcomes"]

Run = Callable[..., int]
"""`swarm VERB ...` for these robots (the fixture `run`); its exit code."""

needs_ssh = pytest.mark.skipif(
    not os.environ.get("CI") and (SSHD is None or shutil.which("ssh") is None),
    reason="needs an ssh server and client: sudo apt-get install openssh-server openssh-client",
)


def outcomes(capsys: pytest.CaptureFixture[str]) -> dict[str, dict[str, object]]:
    """What a command with --json has printed."""
    return dict(json.loads(capsys.readouterr().out)["robots"])
