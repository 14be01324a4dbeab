"""`swarm doctor [ROBOT...]`: look at everything on a robot, and say what is wrong and what to do."""

import argparse
import contextlib
import hashlib
import shlex
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path

from laptop.fleet.core import doctor, steps
from laptop.fleet.core.checkup import ExaminedRobot, Finding
from laptop.fleet.core.wish import FIRMWARE_PACKAGE, KERNEL_PACKAGE, PACKAGES
from laptop.fleet.provision import Rig
from laptop.fleet.ssh import everyone, remote, robot_command
from laptop.fleet.ssh.ssh import CURRENT, Host, HostError, Ssh
from swarm.config import Config, load
from swarm.errors import PayloadError
from swarm.files import free_space
from swarm.messages.json_input import read_json
from swarm.onboard.bootstrap.facts import key_facts
from swarm.onboard.listen import newest_messages
from swarm.process.arguments import show
from swarm.process.simulations import CONFIG

HELP = "test everything on robots (or simulated ones); name faults and what to do"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "which", nargs="*", metavar="ROBOT", help="names of robots (default: all of the simulation, or of the config)"
    )
    robot_command.add_simulation(parser)
    parser.add_argument("--all", action="store_true", help="show checks without a problem as well")
    everyone.add_arguments(parser, timeout_s=60)


def run(args: argparse.Namespace, rig: Rig | None = None) -> int:
    """Examine the robots. Return 0 where nothing is wrong, apart from warnings, and 1 where something is wrong or a
    robot cannot be asked."""
    everyone.named(args)
    there = robot_command.simulated(args)
    found, problems = _real(args, rig or Rig()) if there is None else (_simulated(there), {})
    report = {name: doctor.examine(robot) for name, robot in found.items()}
    swarm_problems = doctor.compare(list(found.values()))
    rows = {name: {check: asdict(each) for check, each in its.items()} for name, its in report.items()}
    lines = text(report, problems, swarm_problems, everything=args.all)
    show(args, {"robots": rows, "problems": problems, "swarm": swarm_problems}, lines)
    wrong = any(each.state == "bad" for its in report.values() for each in its.values())
    return 1 if wrong or problems or swarm_problems else 0


def text(
    report: Mapping[str, Mapping[str, Finding]],
    problems: Mapping[str, str],
    swarm_problems: Sequence[str],
    *,
    everything: bool,
) -> list[str]:
    """Return a table for each robot: the problems, or all findings."""
    out = []
    for name, findings in report.items():
        counts = {state: sum(each.state == state for each in findings.values()) for state in ("bad", "warning", "ok")}
        out.append(f"{name}: {counts['ok']} well, {counts['warning']} warnings, {counts['bad']} wrong")
        for check, each in findings.items():
            if everything or each.state in ("bad", "warning"):
                word = {"bad": "WRONG", "skipped": "-"}.get(each.state, each.state)
                out.append(f"  {check:<9}  {word:<7}  {each.text}")
                if each.remedy:
                    out.append(f"  {'':<9}  {'':<7}  -> {each.remedy}")
    out += [f"{name}: cannot be asked: {problem}" for name, problem in problems.items()]
    out += [f"swarm: {line}" for line in swarm_problems]
    return out


# -- simulated robots ------------------------------------------------------------------------------------------------


def _simulated(there: Mapping[str, Path]) -> dict[str, ExaminedRobot]:
    config = load(next(iter(there.values())).parent / CONFIG)
    said = newest_messages(there)
    key = None if config.mesh.key_file is None else key_facts(config.mesh.key_file)  # all simulated robots share it
    return {
        name: ExaminedRobot(
            name, config, None, said[name], disk=_free(there[name]), key=key, addresses=_addresses(config)
        )
        for name in there
    }


def _free(path: Path) -> int | None:
    with contextlib.suppress(OSError):
        return free_space(path)
    return None


def _addresses(config: Config) -> dict[str, str]:
    return {robot.name: robot.bluetooth for robot in config.robots if robot.bluetooth is not None}


# -- real ones -------------------------------------------------------------------------------------------------------


def _real(args: argparse.Namespace, rig: Rig) -> tuple[dict[str, ExaminedRobot], dict[str, str]]:
    config, wanted, ssh = everyone.recipients(args, named=False)
    digest = hashlib.sha256(config.path.read_bytes()).hexdigest()
    common = ExaminedRobot("", config, None, None, digest=digest, addresses=_addresses(config))
    outcomes, found = everyone.gather(
        wanted, lambda host: _ask(ssh, host, replace(common, name=host.robot), rig), args.timeout
    )
    problems = {each.robot: each.text for each in outcomes if not each.ok}
    return {name: found[name] for name in config.names if name in found and name not in problems}, problems


async def _ask(ssh: Ssh, host: Host, robot: ExaminedRobot, rig: Rig) -> ExaminedRobot:
    """Examine one robot. Raises `HostError` where it cannot be reached."""
    request = {
        **steps.LOOK,
        "key": None if robot.config.mesh.key_file is None else str(robot.config.mesh.key_file),
        "packages": [*PACKAGES, FIRMWARE_PACKAGE, KERNEL_PACKAGE],
        "bluetooth": robot.config.robot(robot.name).link is None,
        "root": rig.root,
        "places": dict(rig.places),
    }
    now = time.time()
    system = await remote.call(ssh, host, "examine", request)
    bus = None
    if system["current"]:
        python = f"{rig.root.rstrip('/')}{CURRENT}/bin/python"
        with contextlib.suppress(
            HostError, PayloadError
        ):  # the check `services` tells of an old release, or of one that does not run
            said = await ssh.check(host, f"sudo -n {python} -P -m swarm.onboard.listen {shlex.quote(robot.name)}")
            bus = read_json(said)
    return replace(robot, system=system, bus=bus, now=now, key=system.get("key"))
