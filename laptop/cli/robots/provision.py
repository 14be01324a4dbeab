"""`swarm provision ROBOT...`: from a fresh Raspberry Pi OS Lite to a robot."""

import argparse
import getpass
import time
from dataclasses import replace
from pathlib import Path

from laptop.fleet.core.wish import DesiredRobot, wish
from laptop.fleet.files.calibrations import with_calibration
from laptop.fleet.posture import add_force, refuse_standing
from laptop.fleet.provision import Provisioning, Rig
from laptop.fleet.release import bundle
from laptop.fleet.release.install import install, read_files, read_release
from laptop.fleet.ssh import everyone
from laptop.fleet.ssh.ssh import Host, Ssh
from swarm.config import Config, load
from swarm.config.load import HOST, HOST_EXAMPLE
from swarm.errors import ConfigError, LocalError

HELP = "turn fresh Raspberry Pis into robots, over ssh"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "which", nargs="*", metavar="ROBOT[=USER@ADDRESS]", help="names of robots (default: all of the config)"
    )
    parser.add_argument("--bundle", type=Path, metavar="FOLDER", help="packages and releases (swarm bundle makes it)")
    parser.add_argument("--key", type=Path, metavar="FILE", help="the swarm's key (swarm key new makes one)")
    parser.add_argument(
        "--wifi", metavar="NAME", help="Wi-Fi network that the robots join; the command asks for its password"
    )
    parser.add_argument(
        "--wifi-password", type=Path, metavar="FILE", help="file with the Wi-Fi password, in place of the question"
    )
    parser.add_argument("--check", action="store_true", help="show what would be changed, and change nothing")
    parser.add_argument(
        "--no-reboot", action="store_true", help="do not reboot; the release is then not installed either"
    )
    add_force(parser)
    everyone.add_arguments(parser, timeout_s=1800)


def run(args: argparse.Namespace, rig: Rig | None = None, architecture: str = "arm64") -> int:
    """Provision the robots and report each step as ok, changed or failed. Return 0 where no step failed on any."""
    config, robots, ssh = _chosen(args)
    packages = {} if args.bundle is None else bundle.repositories(args.bundle)
    paths = [] if args.bundle is None else sorted(args.bundle.glob("balboa-swarm-*.tar.gz"))
    releases = [read_release(path) for path in paths]
    files = read_files(config, args.key)
    whole = {host.robot: with_calibration(files, config, host.robot) for host in robots}
    unaddressed = _unaddressed(config)
    wifi = _wifi(args)

    def asked(host: Host) -> DesiredRobot:
        whole = wish(config, host.robot, host.address, time.time(), key=args.key is not None, wifi=wifi)
        return replace(whole, architecture=architecture)

    async def job(host: Host, tell: everyone.ReportProgress) -> str:
        await everyone.check_answer(ssh, host)
        robot = Provisioning(ssh, host, asked(host), packages, tell, rig or Rig())
        if args.check:
            return await robot.check()
        if not args.force:
            await refuse_standing(ssh, host)
        ready = await robot.carry_out(reboot=not args.no_reboot)
        if not ready:
            return f"{robot.changed} steps changed; reboot it, then provision it again"
        if unaddressed is not None:
            return f"{robot.changed} steps changed; no release yet: swarm pair first ({unaddressed})"
        if not releases:
            return f"{robot.changed} steps changed; no release was given: --bundle with one, or swarm deploy"
        said, _ = await install(ssh, host, releases, whole[host.robot], tell)
        fresh = "nothing to do" not in said
        tell(f"release: {'changed' if fresh else 'ok'}: {said}")
        return f"{robot.changed + fresh} steps changed, all others were ok"

    return everyone.run(args, robots, job)


def _chosen(args: argparse.Namespace) -> tuple[Config, tuple[Host, ...], Ssh]:
    """Return the config, the robots with the addresses that were given for them, and the way to them."""
    addresses = dict(text.partition("=")[::2] for text in args.which)
    if len(addresses) < len(args.which):
        raise LocalError("a robot is named twice")
    if wrong := [address for address in addresses.values() if address and not HOST.fullmatch(address)]:
        raise LocalError(f"{wrong[0]!r}: expected {HOST_EXAMPLE}")
    args.which = list(addresses)
    everyone.named(args)
    config, robots, ssh = everyone.recipients(args, named=False)
    whole = tuple(replace(host, address=addresses.get(host.robot) or host.address) for host in robots)
    there: dict[str, str] = {}
    for host in whole:
        if (other := there.setdefault(host.address.rpartition("@")[2].lower(), host.robot)) != host.robot:
            raise LocalError(f"{other} and {host.robot} would be the same computer, {host.address}")
    return config, whole, ssh


def _unaddressed(config: Config) -> str | None:
    """Name in words the robots without a Bluetooth address in the file; a release refuses such a file."""
    try:
        load(config.path)
    except ConfigError:
        names = [robot.name for robot in config.robots if robot.bluetooth is None and robot.link is None]
        return f"{config.path.name} lacks the Bluetooth address of {' '.join(names)}"
    return None


def _wifi(args: argparse.Namespace) -> tuple[str, str] | None:
    if args.wifi is None:
        return None
    try:
        password = (
            getpass.getpass(f"password of {args.wifi}: ")
            if args.wifi_password is None
            else args.wifi_password.read_text(encoding="utf-8").rstrip("\n")
        )
    except (OSError, EOFError, UnicodeDecodeError) as error:
        why = "it is not UTF-8" if isinstance(error, UnicodeDecodeError) else error  # which would show the password
        raise LocalError(f"the password of {args.wifi} cannot be read: {why}") from None
    odd = any(ord(letter) < 32 for letter in args.wifi + password)
    if odd or not 1 <= len(args.wifi.encode()) <= 32 or not 8 <= len(password) <= 63:
        raise LocalError(
            "a network's name has 1 to 32 bytes, its password 8 to 63 characters, neither control characters"
        )
    return args.wifi, password
