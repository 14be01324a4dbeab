"""`swarm status`: what a robot's answer says of it, and a row for each robot."""

import json
import re

import pytest
from fake_robots import FakeRobots, Run
from needs import needs_ssh

from laptop.cli.robots import status
from laptop.fleet.ssh.everyone import RobotOutcome
from services.balancer.core import faults

pytest_plugins = ["fleet_fixtures"]
pytestmark = needs_ssh

ANSWER = """== release
/opt/swarm/releases/0.1.0-abc
== units
swarm-app@consensus.service loaded active running Balboa Swarm: the app consensus
swarm-balancer.service loaded active running Balboa Swarm: the balancer
swarm-bus.service loaded active running Balboa Swarm: the bus
swarm-mesh.service loaded failed failed Balboa Swarm: the mesh
== runs
312000000	/var/lib/swarm/runs
== bus
{"key": "swarm/r0/balancer/state", "value": {"mode": "balancing", "battery": 7.4, "battery_left": 9000, "fault": ""}}
{"key": "swarm/r0/balancer/firmware", "value": {"layout": 1, "revision": 4}}
{"key": "swarm/r0/mesh/links", "value": {"links": [{"peer": "r1", "state": "up"}, {"peer": "r2", "state": "down"}]}}
{"key": "swarm/r0/dwm/pose", "value": {"x": 1.5, "y": 2.0, "quality": 90}}
{"key": "swarm/r0/app/consensus/progress", "value": {"phase": "running", "k": 12}}
{"key": "swarm/r0/app/consensus/sync/x", "hex": "00"}
{"key": "swarm/r0/dwm/po
"""


def test_the_status_of_a_robot_is_read() -> None:
    row = status.parse("r0", ANSWER)
    assert row == status.StatusRow(
        release="0.1.0-abc",
        firmware="1.4",
        failed=["dwm", "mesh"],
        battery_v=7.4,
        battery_left_s=9000,
        mode="balancing",
        fault=None,
        next=None,
        links={"r1": "up", "r2": "down"},
        clashes=[],
        pose=[1.5, 2.0],
        apps={"consensus": {"phase": "running", "k": 12}},
        recorded=312_000_000,
        misunderstood=[],
    )


def test_the_status_has_a_row_for_each_robot() -> None:
    rows = {"r0": status.parse("r0", ANSWER)}
    head, row = status.table([RobotOutcome("r0", True, "", 1.0)], rows, 2e9)
    assert head.split() == [
        "robot",
        "services",
        "battery",
        "body",
        "links",
        "pose",
        "apps",
        "recordings",
        "release",
        "firmware",
    ]
    assert row == (
        "r0     not running: dwm mesh  7.4 V 2 h 30 min  balancing  1 of 2  1.50 2.00  "
        "consensus:running@12  312.0 MB of 2.00 GB  0.1.0-abc  1.4"
    )


@pytest.mark.parametrize(
    ("mode", "fault", "stopped", "body"),
    [
        ("idle", "", False, "idle, no fault: swarm balance stand"),
        ("fault", "stopped", True, "stopped: take the stop back (swarm arm), then swarm balance stand"),
        ("fault", "stopped", False, "stopped: swarm balance stand"),
        ("fault", "fell", False, "fell: swarm balance stand: it stands up from front or back by itself"),
        ("balancing", "", False, "balancing"),
    ],
)
def test_the_status_says_what_makes_a_robot_stand(mode: str, fault: str, stopped: bool, body: str) -> None:
    said = [
        {"key": "swarm/r0/balancer/state", "value": {"mode": mode, "fault": fault}},
        {"key": "swarm/r0/balancer/fault", "value": {"name": fault, "recovery": faults.RECOVERY.get(fault, "")}},
    ]
    said.append({"key": "swarm/r0/mesh/stopped", "value": {"stopped": stopped}})
    answer = "== bus\n" + "\n".join(map(json.dumps, said))
    rows = {"r0": status.parse("r0", answer)}
    assert body in re.split("  +", status.table([RobotOutcome("r0", True, "", 1.0)], rows, 2e9)[1])


def test_a_robot_that_is_away_has_its_row_too(robots: FakeRobots, run: Run, capsys: pytest.CaptureFixture[str]) -> None:
    robots.add("r0")
    robots.add("r1", up=False)
    assert run("status") == 1
    rows = capsys.readouterr().out.splitlines()
    assert rows[1].startswith("r0     not running: balancer bus dwm mesh")
    assert rows[2] == "r1     it runs no ssh server (or another port)"
