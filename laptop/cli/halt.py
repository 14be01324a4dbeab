"""`swarm estop` and `swarm arm` on a laptop: each robot is told on its own bus by ssh, too, at the same time.

So it is told whatever became of the mesh and of the laptop's bus, and it is confirmed by any of these. A robot whose
own bus or balancer does not confirm a stop has its balancer stopped by systemd: motors off is its last act, and the
ATmega switches them off 0.2 s later in any case.
"""

import argparse
import asyncio
import os
import sys
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from laptop.fleet.ssh import everyone, robot_command
from laptop.fleet.ssh.ssh import Host, HostError, Ssh, hosts, last_words
from swarm.config import Config, load
from swarm.errors import LocalError, PayloadError
from swarm.messages.json_input import read_json
from swarm.onboard import halt
from swarm.onboard.buses import buses
from swarm.onboard.halt import Row
from swarm.process.arguments import show
from swarm.process.paths import DEFAULT_RUNTIME
from swarm.process.terminal import columns

THERE_S = 3.0
"""Seconds for which the command on the robot waits for the robot's own balancer and mesh."""
_SLACK_S = 15.0
"""Further seconds for `swarm arm`: for the connection, and for a robot that is slow to start Python."""
_HANGS_S = 12.0
"""Seconds after which a robot's own command counts as hanging, and its balancer is stopped by systemd."""
_SYSTEMD_S = 15.0
"""Seconds that systemd has for it."""


@dataclass
class _Answers:
    """The answers of ssh, bus and mesh."""

    outcomes: dict[str, everyone.RobotOutcome] = field(default_factory=dict)
    """The outcome of ssh by robot: whether it was reached and has confirmed, and how."""
    seen: dict[str, str] = field(default_factory=dict)
    """Robots whose confirmation another robot has seen over the mesh, with that robot's name."""

    def said(self, robot: str) -> str:
        """Return the answer of ssh in words."""
        return self.outcomes[robot].text if robot in self.outcomes else "ssh gave no answer"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare what a robot's command takes, and the way by ssh."""
    for each in halt.add_arguments(parser):
        each.add_argument("--no-ssh", action="store_true", help="use only bus and mesh, not ssh")
        everyone.add_config(each, "swarm.toml with the robots to reach by ssh")


def run(args: argparse.Namespace) -> int:
    """Stop or arm over every path there is; `LocalError` where there is none.

    Returns 1 where a robot that can be reached has not confirmed in time.
    """
    far = robots_of(args)
    if far is None:
        return halt.run(args)
    stop: bool = args.act == "stop"
    try:
        found = buses.find(args)
    except LocalError:
        found = {}
    answers = _Answers()

    def by_ssh() -> None:
        nonlocal answers
        answers = command(*far, stop=stop, reason=args.reason)

    thread = threading.Thread(target=by_ssh, name="ssh")
    thread.start()
    try:
        rows = halt.give(args, found) if found else []
    except LocalError as error:  # such as a simulation that is just starting or ending
        rows = []
        sys.stderr.write(f"note: {error}\n")
    finally:
        thread.join()
    how = {host.robot: _how(host.robot, rows, answers) for host in far[0]}
    done = all(row.confirmed for row in halt.reached(rows) if row.robot not in how) and all(how.values())
    told = {name: {"confirmed": outcome.ok, "text": outcome.text} for name, outcome in answers.outcomes.items()}
    lines = [*(halt.table(rows, stop=stop) if rows else ()), *table(how, answers, stop=stop)]
    show(args, {**halt.report(args, rows, done), "ssh": told}, lines)
    return 0 if done else 1


def robots_of(args: argparse.Namespace) -> tuple[tuple[Host, ...], Ssh] | None:
    """Return the robots that ssh can reach. None on a robot, for a simulation alone, or without a configuration that
    names robots.

    Raises `LocalError` where a configuration was named and cannot be used.
    """
    if args.no_ssh or args.robots or args.run_dir or os.environ.get("SWARM_RUNTIME") or DEFAULT_RUNTIME.is_dir():
        return None
    try:
        config: Config = load(args.config)
    except LocalError:
        if args.config:
            raise
        return None
    return hosts(config), Ssh(args.ssh_config)


def _how(name: str, rows: Sequence[Row], answers: _Answers) -> str:
    """Return the paths by which a robot is confirmed; empty where it is not."""
    paths = ["bus or mesh"] if any(row.confirmed for row in rows if row.robot == name) else []
    paths += ["ssh"] if name in answers.outcomes and answers.outcomes[name].ok else []
    paths += [f"mesh (seen by {answers.seen[name]})"] if name in answers.seen else []
    return ", ".join(paths)


def table(how: Mapping[str, str], answers: _Answers, *, stop: bool) -> list[str]:
    """Return the lines about the robots that ssh was to reach. `how`: the paths by which each is confirmed."""
    what = "stopped" if stop else "armed"
    lines = [("robot", what, "confirmed by", "ssh says")]
    for name, paths in how.items():
        lines.append((name, "yes" if paths else "NOT CONFIRMED", paths or "-", answers.said(name)))
    missing = [name for name, paths in how.items() if not paths]
    summary = f"{what}: {len(how) - len(missing)} of {len(how)} robots"
    summary += f"; NOT CONFIRMED: {' '.join(missing)}" if missing else ""
    return [*columns(lines), "", summary, *([] if stop else [halt.NEXT])]


def command(robots: tuple[Host, ...], ssh: Ssh, *, stop: bool, reason: str) -> _Answers:
    """Tell all robots at once; returns when each has answered or is given up."""
    answers = _Answers()
    words = [*(["estop", reason] if stop else ["arm"]), "--json", "--timeout", str(THERE_S)]

    async def job(host: Host, tell: everyone.ReportProgress) -> str:
        try:
            async with asyncio.timeout(_HANGS_S if stop else None):
                done = await ssh.run(host, robot_command.words(host, words))
            out, error = done.out, last_words(done.err)
        except TimeoutError:
            out, error = "", f"its own command has not ended within {_HANGS_S:g} s"
        rows = _rows(out)
        for name, row in rows.items():
            if row.get("confirmed") and name != host.robot:
                answers.seen[name] = host.robot
        own = rows.get(host.robot, {})
        if own.get("confirmed") and not stop:
            return "its own bus says so"
        if own.get("confirmed") and own.get("mode") is not None:
            return "its own bus and balancer say so"
        silent = "its balancer tells no state" if own.get("confirmed") else "its bus does not confirm it"
        problem = error.removeprefix("swarm: ") or silent
        if not stop:
            raise HostError(problem)
        await ssh.check(host, "sudo -n systemctl stop swarm-balancer.service")
        return f"its balancer was stopped ({problem}): swarm services start balancer, when all is well"

    try:
        found = asyncio.run(everyone.each(robots, job, _HANGS_S + _SYSTEMD_S if stop else THERE_S + _SLACK_S))
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
