"""`swarm deploy [RELEASE...]`: bring a release, config and key to all robots and switch to it."""

import argparse
import tempfile
from collections.abc import Sequence
from pathlib import Path

from laptop.fleet.files.calibrations import with_calibration
from laptop.fleet.posture import add_force, refuse_standing
from laptop.fleet.release.install import Release, ask_kind, install, read_files, read_release
from laptop.fleet.release.release import build
from laptop.fleet.ssh import everyone
from laptop.fleet.ssh.ssh import Host, Ssh
from swarm.config import Config
from swarm.errors import LocalError

HELP = "install a release, config and key on all robots, over ssh"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare releases, and what goes with them."""
    parser.add_argument(
        "releases",
        nargs="*",
        type=Path,
        metavar="RELEASE",
        help="file of a release (default: make one of this installation)",
    )
    parser.add_argument(
        "--key",
        type=Path,
        metavar="FILE",
        help="the swarm's key (from swarm key new), if the robots do not have it yet",
    )
    parser.add_argument("--rename", action="store_true", help="allow that a robot gets another name")
    add_force(parser)
    everyone.add_arguments(parser, timeout_s=600)


def run(args: argparse.Namespace) -> int:
    """Install the release that fits each robot. Return 0 where it runs on every one."""
    config, robots, ssh = everyone.recipients(args, addressed=True, named=not args.rename)
    files = read_files(config, args.key)
    whole = {host.robot: with_calibration(files, config, host.robot) for host in robots}
    releases = [read_release(path) for path in args.releases] or _made(config, robots, ssh, args.timeout)
    for release in releases:
        if missing := release.lacks(config.packages):
            raise LocalError(
                f"{release.path.name} lacks {' '.join(missing)}, which [robot] packages of {config.path} names: "
                "without a release, swarm deploy makes one that has them"
            )

    async def job(host: Host, tell: everyone.ReportProgress) -> str:
        await everyone.check_answer(ssh, host)
        if not args.force:
            await refuse_standing(ssh, host)
        said, sent = await install(ssh, host, releases, whole[host.robot], tell)
        return f"{said} ({sent} bytes sent)"

    return everyone.run(args, robots, job)


def _made(config: Config, robots: Sequence[Host], ssh: Ssh, timeout_s: float) -> list[Release]:
    """Make a release for each kind of robot that answers. A robot that does not answer is named when it gets none."""
    _, found = everyone.gather(robots, lambda host: ask_kind(ssh, host), min(timeout_s, everyone.ASK_S))
    with tempfile.TemporaryDirectory() as folder:
        kinds = sorted({kind for kind in found.values() if kind is not None})
        return [read_release(build(Path(folder), *kind, config.packages)) for kind in kinds]
