"""`swarm estop` and `swarm arm` by ssh: every robot is told on its own bus, whatever became of mesh and laptop's bus.

A robot whose own bus or balancer does not confirm a stop has its balancer stopped by systemd: motors off is its last
act, and the ATmega switches them off 0.2 s later in any case.
"""

import argparse
import asyncio
import os
import shlex
from dataclasses import dataclass, field
from typing import Any

from laptop.fleet import everyone
from laptop.fleet.everyone import ReportProgress
from laptop.fleet.ssh import Host, HostError, Ssh, hosts, last_words
from swarm.config import Config, load
from swarm.errors import LocalError, PayloadError
from swarm.messages.json_input import read_json
from swarm.process.paths import DEFAULT_RUNTIME

PROGRAM = "/opt/swarm/current/bin/swarm"
THERE_S = 3.0
"""That the robot waits for its own balancer and mesh."""
_SLACK_S = 15.0
"""For the connection and a robot that is slow to start Python."""


@dataclass
class Answers:
    """What came back."""

    outcomes: dict[str, everyone.RobotOutcome] = field(default_factory=dict)
    """By robot: whether it was reached and has confirmed, and how."""
    seen: dict[str, str] = field(default_factory=dict)
    """Robots that another one has seen confirm, over the mesh: its name."""


def robots_of(args: argparse.Namespace) -> tuple[tuple[Host, ...], Ssh] | None:
    """Whom ssh can reach; None on a robot, for a simulation alone, or without a configuration that names robots.

    Raises `LocalError` where a configuration was named and cannot be used.
    """
    if args.no_ssh or args.robot or args.run_dir or os.environ.get("SWARM_RUNTIME") or DEFAULT_RUNTIME.is_dir():
        return None
    try:
        config: Config = load(args.config)
    except LocalError:
        if args.config:
            raise
        return None
    return hosts(config), Ssh(args.ssh_config)


def command(robots: tuple[Host, ...], ssh: Ssh, *, stop: bool, reason: str) -> Answers:
    """Tell all robots at once; returns when each has answered or is given up."""
    answers = Answers()
    words = [PROGRAM, "estop", reason] if stop else [PROGRAM, "arm"]

    async def job(host: Host, tell: ReportProgress) -> str:
        there = ["sudo", "-n", "env", f"SWARM_ROBOT={host.robot}", f"SWARM_RUNTIME={DEFAULT_RUNTIME}", *words]
        done = await ssh.run(host, shlex.join([*there, "--json", "--timeout", str(THERE_S)]))
        rows = _rows(done.out)
        for name, row in rows.items():
            if row.get("confirmed") and name != host.robot:
                answers.seen[name] = host.robot
        if rows.get(host.robot, {}).get("confirmed"):
            return "its own bus and balancer say so" if stop else "its own bus says so"
        problem = last_words(done.err).removeprefix("swarm: ") or "its bus does not confirm it"
        if not stop:
            raise HostError(problem)
        await ssh.check(host, "sudo -n systemctl stop swarm-balancer.service")
        return f"its balancer was stopped ({problem}): swarm services start balancer, when all is well"

    try:
        found = asyncio.run(everyone.each(robots, job, THERE_S + _SLACK_S, lambda *_: None))
    except LocalError as error:  # there is no ssh here: nobody was told
        found = [everyone.RobotOutcome(host.robot, False, str(error), 0.0) for host in robots]
    answers.outcomes = {outcome.robot: outcome for outcome in found}
    return answers


def _rows(text: str) -> dict[str, dict[str, Any]]:
    """The far command's rows by robot; none where it printed something else."""
    try:
        return {str(row["robot"]): dict(row) for row in read_json(text)["robots"]}
    except (PayloadError, ValueError, LookupError, TypeError):
        return {}
