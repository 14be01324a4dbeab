"""`swarm commission ROBOT` on a laptop: a robot of a simulation, or a real one by its own command."""

import argparse
import json
from typing import Any

from laptop.cli import halt
from laptop.cli.robots.body.drive import far, show
from laptop.fleet.ssh import remote_keys, robot_command
from swarm.errors import LocalError, PayloadError
from swarm.messages.json_input import read_json
from swarm.onboard.commission import command
from swarm.onboard.commission.core.motor_steps import REASON
from swarm.onboard.commission.core.procedure import PASSED
from swarm.process.terminal import write_lines


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare what a robot's command takes, and the way by ssh."""
    command.add_arguments(parser)
    robot_command.add_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Lead through all steps. Return 1 where not all of them have passed.

    Where the robot, the connection or the person breaks off, the report is that of the steps until then, and says so.
    """
    if not robot_command.is_far(args):
        return command.run(args)
    host, ssh = far(args)
    reports: list[dict[str, Any]] = []
    so_far: list[dict[str, Any]] = []

    def line(text: str) -> None:
        found = _read(text)
        if isinstance(report := found.get("report"), dict):
            reports.append(report)
            if not args.json:
                return
        if isinstance(report := found.get("so_far"), dict):
            so_far.append(report)
        if args.json:
            write_lines([text])
        elif "say" in found:
            show(("  ? " if "ask" in found else "") + str(found["say"]))
        if found.get("say") == command.STOPPED:
            halt.stop_all(REASON, args, as_json=args.json)

    code = 1
    try:
        code = remote_keys.run(ssh, host, robot_command.words(host, ["commission", "--json"]), line)
        ended = f"{host.robot}: its command has ended without a report (exit code {code})"
    except LocalError as error:
        ended = str(error)
    except KeyboardInterrupt:
        if not so_far:
            raise
        ended = "ended by Ctrl-C"
    if not reports:
        if not so_far:
            raise LocalError(ended)
        reports.append({**so_far[-1], "ended": ended})
        code = 0 if reports[-1].get("verdict") == PASSED else 1
        if args.json:
            write_lines([json.dumps({"report": reports[-1]})])
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
