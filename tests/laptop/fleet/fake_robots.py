"""Robots that are a real OpenSSH server each (bench/rigs/fake_robots.py), for tests."""

import json
from collections.abc import Callable

import pytest

from bench.rigs.fake_robots import SSHD, FakeRobots

__all__ = ["SSHD", "FakeRobots", "Run", "outcomes"]

Run = Callable[..., int]
"""`swarm VERB ...` for these robots (the fixture `run`); its exit code."""


def outcomes(capsys: pytest.CaptureFixture[str]) -> dict[str, dict[str, object]]:
    """What a command with --json has printed."""
    return dict(json.loads(capsys.readouterr().out)["robots"])
