"""`swarm deploy RELEASE...`: bring a release, config and key to all robots and switch to it."""

import argparse
from pathlib import Path

from laptop.fleet import everyone
from laptop.fleet.everyone import ReportProgress
from laptop.fleet.install import check_name, install, read_files, read_release
from laptop.fleet.ssh import Host

HELP = "bring a release, config and key to all robots and switch to it, over ssh"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Releases, and what goes with them."""
    parser.add_argument(
        "releases", nargs="+", type=Path, metavar="RELEASE", help="of deploy/release; one for each kind of robot"
    )
    parser.add_argument("--key", type=Path, metavar="FILE", help="the swarm's key (swarm key new), where it is new")
    parser.add_argument("--rename", action="store_true", help="even where a robot has another name so far")
    everyone.add_arguments(parser, timeout_s=600)


def run(args: argparse.Namespace) -> int:
    """Each robot gets the release that fits it; 0 where it runs on every one."""
    config, robots, ssh = everyone.chosen(args)
    releases = [read_release(path) for path in args.releases]
    files = read_files(config.path, args.key)

    async def job(host: Host, tell: ReportProgress) -> str:
        if not args.rename:
            await check_name(ssh, host)
        said, sent = await install(ssh, host, releases, files, tell)
        return f"{said} ({sent} bytes sent)"

    return everyone.run(args, robots, job)
