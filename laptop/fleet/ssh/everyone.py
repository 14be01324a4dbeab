"""The same on every robot at the same time: progress as it comes, an outcome for each, none waits for another."""

import argparse
import asyncio
import sys
import time
from collections.abc import Awaitable, Callable, Collection, Coroutine, Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from laptop.fleet.core.answers import MISUNDERSTOOD, misunderstood
from laptop.fleet.ssh.ssh import Host, HostError, Ssh, hosts
from swarm.config import Config, load
from swarm.config.find import LOOKED_IN
from swarm.errors import LocalError
from swarm.frozen import frozen
from swarm.process.arguments import add_json, add_robots, number, show
from swarm.process.terminal import columns, write_lines


@frozen
class RobotOutcome:
    """The outcome on one robot."""

    robot: str
    ok: bool
    text: str
    seconds: float


T = TypeVar("T")

ReportProgress = Callable[[str], None]
"""A function that reports the progress of one robot."""
Job = Callable[[Host, ReportProgress], Awaitable[str]]
"""Does the work on one robot and returns a line about it; raises `HostError`."""


ASK_S = 30.0
"""Seconds that a robot has to answer a question on which all other robots wait, such as which release it runs."""

FAILURES = (TimeoutError, *MISUNDERSTOOD)
"""Errors that end the job of one robot and not those of the others; `HostError` is one of them."""


def failure(error: BaseException, timeout_s: float) -> str:
    """Return in words why a job has failed on a robot."""
    if isinstance(error, TimeoutError):
        return f"not done within {timeout_s:g} s"
    return str(error) if isinstance(error, HostError) else misunderstood(error)


def add_arguments(parser: argparse.ArgumentParser, *, timeout_s: float) -> None:
    """Declare what all commands for robots have in common."""
    add_robots(parser, "names of robots (default: all of the config)")
    add_json(parser)
    add_way(parser, timeout_s=timeout_s)


def add_way(parser: argparse.ArgumentParser, *, timeout_s: float) -> None:
    """Declare how robots are reached, and how long each may take."""
    add_config(parser, f"swarm.toml with the robots (default: {LOOKED_IN})")
    text = f"seconds to wait for each robot ({timeout_s:g})"
    parser.add_argument("--timeout", type=number(0, unit="s", above=True), default=timeout_s, metavar="S", help=text)


def add_config(parser: argparse.ArgumentParser, text: str) -> None:
    """Declare `--config`, which `text` explains, and `--ssh-config`."""
    parser.add_argument("--config", type=Path, metavar="FILE", help=text)
    parser.add_argument("--ssh-config", type=Path, metavar="FILE", help="ssh configuration, in place of ~/.ssh/config")


def recipients(
    args: argparse.Namespace, *, addressed: bool = False, named: bool = True
) -> tuple[Config, tuple[Host, ...], Ssh]:
    """Return the config and robots that the arguments name, and the way to them.

    With `addressed` the config must have all Bluetooth addresses, as robots need it. `named`: see `Ssh`.
    """
    config = load(args.config, addressed=addressed)
    return config, hosts(config, args.robots), Ssh(args.ssh_config, named=named)


def named(args: argparse.Namespace) -> None:
    """Take the robots that were given as arguments (`args.which`) for those of `--robots`; raises `LocalError`."""
    if args.which and args.robots:
        raise LocalError("name the robots by --robots or as arguments, not by both")
    args.robots = args.which or args.robots


def refuse_robots(words: Iterable[str], robots: Collection[str], wanted: str) -> None:
    """Raise `LocalError` where robots' names were given in place of what is `wanted`."""
    if given := [word for word in words if word in robots]:
        raise LocalError(f"{given[0]} is a robot, and not {wanted}: name robots by --robots {','.join(given)}")


async def check_answer(ssh: Ssh, host: Host) -> None:
    """Raise `HostError` where a robot that hangs does not answer within `ASK_S`, before work that may take longer."""
    try:
        async with asyncio.timeout(ASK_S):
            await ssh.check(host, "true")
    except TimeoutError:
        raise HostError(f"it has not answered within {ASK_S:g} s") from None


async def each(
    robots: Sequence[Host], job: Job, timeout_s: float, tell: Callable[[Host, str], None] = lambda *_: None
) -> list[RobotOutcome]:
    """Run the job on all robots at once, `timeout_s` for each. A robot that fails does not disturb the others."""

    async def one(host: Host) -> RobotOutcome:
        began, text, problem = time.monotonic(), "", ""
        try:
            async with asyncio.timeout(timeout_s):
                text = await job(host, partial(tell, host))
        except FAILURES as error:
            problem = failure(error, timeout_s)
        return RobotOutcome(host.robot, not problem, problem or text, round(time.monotonic() - began, 3))

    return await together(one(host) for host in robots)


async def together(jobs: Iterable[Coroutine[Any, Any, T]]) -> list[T]:
    """Run all at once and return their results. If this is cancelled, or one fails, each of the others is cancelled
    once and has time to end its connection: `asyncio.gather` would leave that to its loop, which cancels them again."""
    try:
        async with asyncio.TaskGroup() as group:
            tasks = [group.create_task(job) for job in jobs]
    except BaseExceptionGroup as errors:
        raise errors.exceptions[0] from None
    return [task.result() for task in tasks]


def gather(
    robots: Sequence[Host], ask: Callable[[Host], Awaitable[T]], timeout_s: float
) -> tuple[list[RobotOutcome], dict[str, T]]:
    """Ask all robots at once. Return the outcome on each, and the answers by robot."""
    answers: dict[str, T] = {}

    async def job(host: Host, _: ReportProgress) -> str:
        answers[host.robot] = await ask(host)
        return ""

    return asyncio.run(each(robots, job, timeout_s)), answers


def run(args: argparse.Namespace, robots: Sequence[Host], job: Job) -> int:
    """Run the job on all robots, print the outcomes, and return 0 if all succeeded."""
    lines: dict[str, list[str]] = {host.robot: [] for host in robots}

    def tell(host: Host, text: str) -> None:
        if args.json:
            lines[host.robot].append(text)
        else:  # none is kept: a log that is followed has no end
            write_lines([f"{host.robot}: {text}"])
            sys.stdout.flush()

    began = time.monotonic()
    outcomes = asyncio.run(each(robots, job, args.timeout, tell))
    rows = {
        each.robot: {"ok": each.ok, "text": each.text, "seconds": each.seconds, "lines": lines[each.robot]}
        for each in outcomes
    }
    show(args, {"robots": rows, "seconds": round(time.monotonic() - began, 3)}, table(outcomes))
    return 0 if all(outcome.ok for outcome in outcomes) else 1


def table(outcomes: Sequence[RobotOutcome]) -> list[str]:
    """Return the lines of a table, one for each robot."""
    return columns(
        [(each.robot, "ok" if each.ok else "FAILED", f"{each.seconds:6.1f} s", each.text) for each in outcomes]
    )
