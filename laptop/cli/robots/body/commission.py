"""`swarm commission ROBOT` on a laptop: a robot of a simulation, or a real one by its own command."""

import argparse
from typing import Any

from laptop.cli import halt
from laptop.cli.robots.body.drive import far, show
from laptop.fleet.ssh import remote_keys, robot_command
from swarm.errors import LocalError, PayloadError
from swarm.messages.json_input import read_json
from swarm.onboard.commission import command
from swarm.onboard.commission.core.motor_steps import REASON
from swarm.process.terminal import write_lines


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare what a robot's command takes, and the way by ssh."""
    command.add_arguments(parser)
    robot_command.add_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Lead through all steps. Return 1 where not all of them have passed."""
    if not robot_command.is_far(args):
        return command.run(args)
    host, ssh = far(args)
    reports: list[dict[str, Any]] = []

    def line(text: str) -> None:
        found = _read(text)
        if isinstance(report := found.get("report"), dict):
            reports.append(report)
            if not args.json:
                return
        if args.json:
            write_lines([text])
        elif "say" in found:
            show(("  ? " if "ask" in found else "") + str(found["say"]))
        if found.get("say") == command.STOPPED:
            halt.stop_all(REASON, args, as_json=args.json)

    code = remote_keys.run(ssh, host, robot_command.words(host, ["commission", "--json"]), line)
    if not reports:
        raise LocalError(f"{host.robot}: its command has ended without a report (exit code {code})")
    if not args.json:
        try:
            command.finish(reports[-1], args.out)
        except (KeyError, TypeError) as error:
            raise LocalError(f"{host.robot}: its report cannot be read: {error!r}") from None
    return code


def _read(text: str) -> dict[str, Any]:
    """Return the object in a line of the robot; where there is none, the line itself as something said."""
    try:
        found = read_json(text)
    except PayloadError:
        found = None
    return found if isinstance(found, dict) else {"say": text}
