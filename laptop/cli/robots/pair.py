"""`swarm pair`: pair all neighbours over Bluetooth, without a person at any robot."""

import argparse
import asyncio
import sys
import time

from laptop.fleet.core.pairing import bluetooth_links, check, with_addresses
from laptop.fleet.pair import Pairing, look
from laptop.fleet.ssh import everyone
from swarm.config import Config, parse
from swarm.errors import ConfigError, LocalError
from swarm.files import atomic_write
from swarm.process.arguments import show
from swarm.process.terminal import write_lines

HELP = "pair all neighbours over Bluetooth; write missing addresses into swarm.toml"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--check", action="store_true", help="show which links are paired, and change nothing")
    parser.add_argument("--again", action="store_true", help="delete all pairings of these links, and pair again")
    everyone.add_arguments(parser, timeout_s=180)


def run(args: argparse.Namespace) -> int:
    """Print a line for each link. Return 0 where all are paired and trusted at both ends."""
    if args.check and args.again:
        raise LocalError("--check changes nothing and --again does: give only one of the two")
    config, robots, ssh = everyone.recipients(args)
    began = time.monotonic()
    found, looks = everyone.gather(robots, lambda host: look(ssh, host), min(args.timeout, everyone.ASK_S))
    wrong = check(config, {name: answer["address"] for name, answer in looks.items()})
    outcomes = [
        everyone.RobotOutcome(each.robot, False, wrong[each.robot], each.seconds) if each.robot in wrong else each
        for each in found
    ]
    good = {name: answer for name, answer in looks.items() if name not in wrong}
    if not args.check:
        config = _complete(config, {name: answer["address"] for name, answer in good.items()}, args.json)
    wanted = bluetooth_links(config, [host.robot for host in robots])
    pairing = Pairing(ssh, {host.robot: host for host in robots}, good, args.timeout, _tell(args.json))
    links = asyncio.run(pairing.carry_out(wanted, check=args.check, again=args.again))
    rows = {each.robot: {"ok": each.ok, "text": each.text} for each in outcomes}
    answer = {"robots": rows, "links": {f"{a} {b}": text or "paired" for (a, b), text in links.items()}}
    lines = [f"{each.robot}: {each.text}" for each in outcomes if not each.ok]
    lines += [f"{a} {b}  {'FAILED  ' + text if text else 'paired'}" for (a, b), text in links.items()]
    show(args, answer | {"seconds": round(time.monotonic() - began, 3)}, lines)
    return 0 if all(each.ok for each in outcomes) and not any(links.values()) else 1


def _tell(quiet: bool) -> everyone.ReportProgress:
    def tell(text: str) -> None:
        if not quiet:
            write_lines([text])
            sys.stdout.flush()

    return tell


def _complete(config: Config, addresses: dict[str, str], quiet: bool) -> Config:
    """Write the addresses that the file lacks; raises `LocalError` where it cannot be done without harm."""
    radio = {robot.name for robot in config.robots if robot.bluetooth is None and robot.link is None}
    missing = {name: address for name, address in addresses.items() if name in radio}
    if not missing:
        return config
    text = with_addresses(config.path.read_text(encoding="utf-8"), missing)
    rows = "".join(f'\n  {name}: bluetooth = "{address}"' for name, address in missing.items())
    try:
        new = parse(text, config.path, addressed=False)
    except ConfigError:
        new = config
    if any(new.robot(name).bluetooth != address for name, address in missing.items()):
        raise LocalError(f"{config.path}: cannot be edited safely; write into it yourself:{rows}")
    try:
        atomic_write(config.path, text.encode())
    except OSError as error:
        raise LocalError(f"{config.path}: cannot be written: {error.strerror}; write into it yourself:{rows}") from None
    if not quiet:
        sys.stdout.write(f"{config.path}: written:{rows}\n")
    return new
