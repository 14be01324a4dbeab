"""A command of robots, given on a laptop for real ones: each runs its own `swarm` over ssh, and its words come here.

`Command.far` names this module. Where a simulation runs here, or this is a robot, the command is run here instead.
"""

import argparse
from collections.abc import Sequence

from laptop.fleet.core.answers import misunderstood
from laptop.fleet.ssh import everyone, robot_command
from laptop.fleet.ssh.ssh import Done, Host, Ssh, hosts, last_words
from services.balancer import measure_i2c
from swarm.config import load
from swarm.errors import PayloadError
from swarm.messages.json_input import read_json
from swarm.process.arguments import CommandParser, add_json, add_robots, add_run_dir, show

TIMEOUT_S = 600.0
"""Seconds to wait for each robot: a measurement may take minutes."""

FROM_ONE = ("mesh topology", "mesh epoch", "measure rtt", "measure throughput", "measure rssi")
"""Commands that one robot carries out for all: the robot that is named first, else the first of the configuration."""
OF_EACH = {"measure i2c": measure_i2c}
"""Commands whose arguments `names` are the robots, each of which carries them out; with their modules."""

_HERE = {"-h", "--help", "--port", "--ranges"}
"""Options with which a command concerns this computer, not the robots."""


def reader(name: str) -> argparse.ArgumentParser:
    """Return the parser of the options that say which robots are meant, real or simulated, and how to report."""
    found = argparse.ArgumentParser(prog=f"swarm {name}", add_help=False, allow_abbrev=False)
    robot_command.add_arguments(found)
    add_robots(found, "")
    add_run_dir(found)
    add_json(found)
    return found


def run(name: str, words: Sequence[str]) -> int | None:
    """Run `swarm NAME WORDS` on the real robots that are meant; None where none is.

    The exit code is the largest of theirs, 1 where one cannot be reached.
    """
    if _HERE & {word.partition("=")[0] for word in words}:
        return None
    args, rest = reader(name).parse_known_args(words)
    if not robot_command.is_meant(args):
        return None
    config = load(args.config, addressed=False)
    if name in OF_EACH:
        args.which = _named(name, rest)
        rest = [word for word in rest if word not in args.which]
        everyone.named(args)
    if name in FROM_ONE:
        named = [word for word in rest if word in config.names]
        args.robots = (args.robots or named or list(config.names))[:1]
    ssh, command = Ssh(args.ssh_config), [*name.split(), *rest, *(["--json"] if args.json else [])]

    async def ask(host: Host) -> Done:
        await everyone.check_answer(ssh, host)
        return await ssh.run(host, robot_command.words(host, command))

    return _show(args, *everyone.gather(hosts(config, args.robots), ask, TIMEOUT_S))


def _named(name: str, words: Sequence[str]) -> list[str]:
    """Return the robots that the words of a command of `OF_EACH` name. A word that it does not understand ends it."""
    parser = CommandParser(prog=f"swarm {name}")
    OF_EACH[name].add_arguments(parser)
    return list(parser.parse_args(words).names)


def _show(args: argparse.Namespace, outcomes: Sequence[everyone.RobotOutcome], said: dict[str, Done]) -> int:
    lines: list[str] = []
    data: dict[str, object] = {}
    codes = [0]
    for outcome in outcomes:
        done = said.get(outcome.robot)
        problem = outcome.text if done is None else "" if done.out.strip() else last_words(done.err)
        if args.json and done is not None and not problem:
            try:
                data[outcome.robot] = read_json(done.out)
            except PayloadError as error:  # as from a ~/.bashrc that prints
                done, problem = None, misunderstood(error)
        codes.append(1 if done is None else done.code)
        if done is None or problem:
            lines.append(f"{outcome.robot}: {problem.removeprefix('swarm: ') or 'it has said nothing'}")
            data[outcome.robot] = {"problem": problem}
            continue
        lines += [line if len(outcomes) == 1 else f"[{outcome.robot}] {line}" for line in done.out.splitlines()]
    show(args, {"robots": data}, lines)
    return max(codes)
