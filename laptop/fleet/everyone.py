"""The same on every robot at the same time: progress as it comes, an outcome for each, none waits for another."""

import argparse
import asyncio
import json
import sys
import time
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import asdict
from pathlib import Path

from laptop.fleet.core.answers import MISUNDERSTOOD, misunderstood
from laptop.fleet.ssh import Host, HostError, Ssh, hosts
from swarm.config import Config, load
from swarm.errors import LocalError
from swarm.frozen import frozen
from swarm.process.terminal import write_lines


@frozen
class RobotOutcome:
    """What came of it on one robot."""

    robot: str
    ok: bool
    text: str
    seconds: float
    lines: tuple[str, ...] = ()
    """What was told of it on the way."""


ReportProgress = Callable[[str], None]
"""Says how far a robot has come."""
Job = Callable[[Host, ReportProgress], Awaitable[str]]
"""Does the work on one robot and returns a line about it; raises `HostError`."""


def add_arguments(parser: argparse.ArgumentParser, *, timeout_s: float) -> None:
    """What all commands for robots have in common."""
    parser.add_argument("--robots", metavar="r0,r3", help="only these (default: all of the config)")
    parser.add_argument("--config", type=Path, metavar="FILE", help="default: SWARM_CONFIG, else /etc/swarm/swarm.toml")
    parser.add_argument("--ssh-config", type=Path, metavar="FILE", help="in place of ~/.ssh/config")
    parser.add_argument("--timeout", type=float, default=timeout_s, metavar="S", help=f"for each robot ({timeout_s:g})")
    parser.add_argument("--json", action="store_true", help="the outcomes as one JSON object, nothing else")


def chosen(args: argparse.Namespace) -> tuple[Config, tuple[Host, ...], Ssh]:
    """The config and robots that the arguments name, and the way to them."""
    if args.timeout <= 0:
        raise LocalError(f"--timeout {args.timeout:g}: expected a time above 0")
    config = load(args.config)
    return config, hosts(config, args.robots), Ssh(args.ssh_config)


async def each(
    robots: Sequence[Host], job: Job, timeout_s: float, tell: Callable[[Host, str], None]
) -> list[RobotOutcome]:
    """Run the job on all robots at once; `timeout_s` for each. What one robot does not do harms no other."""

    async def one(host: Host) -> RobotOutcome:
        began, lines = time.monotonic(), []

        def say(text: str) -> None:
            lines.append(text)
            tell(host, text)

        try:
            async with asyncio.timeout(timeout_s):
                text, ok = await job(host, say), True
        except HostError as error:
            text, ok = str(error), False
        except TimeoutError:
            text, ok = f"not done within {timeout_s:g} s (--timeout)", False
        except MISUNDERSTOOD as error:
            text, ok = misunderstood(error), False
        return RobotOutcome(host.robot, ok, text, round(time.monotonic() - began, 3), tuple(lines))

    return list(await asyncio.gather(*(one(host) for host in robots)))


def run(args: argparse.Namespace, robots: Sequence[Host], job: Job) -> int:
    """Do it, show it, and return the exit code: 0 only where every robot has done it."""

    def tell(host: Host, text: str) -> None:
        if not args.json:
            write_lines([f"{host.robot}: {text}"])
            sys.stdout.flush()

    began = time.monotonic()
    outcomes = asyncio.run(each(robots, job, args.timeout, tell))
    if args.json:
        rows = {outcome.robot: {k: v for k, v in asdict(outcome).items() if k != "robot"} for outcome in outcomes}
        sys.stdout.write(json.dumps({"robots": rows, "seconds": round(time.monotonic() - began, 3)}) + "\n")
    else:
        write_lines(table(outcomes))
    return 0 if all(outcome.ok for outcome in outcomes) else 1


def table(outcomes: Sequence[RobotOutcome]) -> list[str]:
    """One row a robot."""
    width = max(len(outcome.robot) for outcome in outcomes)
    return [
        f"{outcome.robot:<{width}}  {'ok    ' if outcome.ok else 'FAILED'}  {outcome.seconds:6.1f} s  {outcome.text}"
        for outcome in outcomes
    ]
