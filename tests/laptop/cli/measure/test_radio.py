"""`swarm measure radio`: recorded runs are read, fitted and told; test_radio_page.py has the rehearsal."""

import argparse
import json
from pathlib import Path

import pytest

from laptop.cli.measure import radio
from sim.virtual.run import run_virtually
from swarm.errors import LocalError
from swarm.messages import LinkState


def record(path: Path, iterations: int) -> None:
    run_virtually(
        "consensus", "--robots", "4", "--topology", "loop", "--links", "graph", "--radio", "slots:stay=0.25",
        "--iterations", str(iterations), "--record", str(path),
    )  # fmt: skip


@pytest.mark.slow
def test_a_loop_tells_how_long_bridges_stay_and_nothing_of_hosts(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    record(tmp_path / "loop", 40)
    args = argparse.Namespace(runs=[tmp_path / "loop"], iterations=25, json=True)
    assert radio.run(args) == 0
    found = json.loads(capsys.readouterr().out)
    assert list(found["parameters"]) == ["stay"]
    assert 0.15 < found["parameters"]["stay"]["value"] < 0.4
    assert (found["runs"][0]["links"], found["runs"][0]["piconets"]) == (4, 2)
    args.json = False
    assert radio.run(args) == 0
    text = capsys.readouterr().out
    assert "host: no run tells it" in text
    assert "simulate this radio with: --radio slots:stay=0." in text


def test_a_run_that_is_too_short_is_said(tmp_path: Path) -> None:
    record(tmp_path / "short", 12)
    with pytest.raises(LocalError, match="too short: expected 20 iterations"):
        radio.run(argparse.Namespace(runs=[tmp_path / "short"], iterations=20, json=False))


def test_links_that_were_lost_are_counted_once_and_wrong_roles_are_named() -> None:
    def link(peer: str, state: str, connection: int, role: str = "central") -> LinkState:
        return LinkState(peer, state, connection, 0.05, 1, 1, "", 0.04, 0.05, 0.2, role=role, wanted_role="central")

    told = {
        "r0": [link("r1", "up", 3), link("r2", "down", 1), link("r3", "down", 0)],
        "r1": [link("r0", "up", 3, "peripheral")],
    }
    found = radio._radio(0.1, told)
    assert (found.lost, found.wrong) == (3, ("r1 r0",))
    assert (found.rtt_median, found.rtt_p99) == (0.05, 0.2)
