"""`swarm deploy RELEASE...`: bring a release, config and key to all robots and switch to it."""

import argparse
import shlex
from pathlib import Path

from swarm.errors import LocalError
from swarm.fleet import everyone, transfer
from swarm.fleet.everyone import Tell
from swarm.fleet.ssh import Host

HELP = "bring a release, config and key to all robots and switch to it, over ssh"

_WHAT = "uname -m; for v in 3.11 3.12 3.13 3.14; do command -v python$v >/dev/null && echo $v; done; true"

_INSTALL = (
    "umask 077; own=$(mktemp -d) || exit 1; trap 'rm -rf $own' EXIT; "
    f"tar --extract --file=- --directory=$own && cd {transfer.FOLDER} && sudo -n ./install --name $robot "
)
"""Config and key come as a tar; nothing of them stays behind in a home folder."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Releases, and what goes with them."""
    parser.add_argument(
        "releases", nargs="+", type=Path, metavar="RELEASE", help="of deploy/release; one for each kind of robot"
    )
    parser.add_argument("--key", type=Path, metavar="FILE", help="the swarm's key (swarm key new), where it is new")
    everyone.add_arguments(parser, timeout_s=600)


def run(args: argparse.Namespace) -> int:
    """Each robot gets the release that fits it; 0 where it runs on every one."""
    config, robots, ssh = everyone.chosen(args)
    releases = [transfer.read_release(path) for path in args.releases]
    options = {"config": config.path, "key": args.key}
    files = {name: _read(path) for name, path in options.items() if path is not None}
    data = transfer.pack(files, {})
    install = _INSTALL + " ".join(f"--{name} $own/{name}" for name in files)

    async def job(host: Host, tell: Tell) -> str:
        machine, *pythons = (await ssh.check(host, _WHAT)).split()
        release = transfer.fitting(releases, machine, pythons)
        sent = await transfer.bring(ssh, host, release, tell)
        tell("installing")
        said = await ssh.check(host, f"robot={shlex.quote(host.robot)}; {install}", feed=[data])
        return f"{said.strip().splitlines()[-1].removeprefix('install: ')} ({sent + len(data)} bytes sent)"

    return everyone.run(args, robots, job)


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise LocalError(f"{path} cannot be read: {error.strerror}") from None
