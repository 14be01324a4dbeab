"""`swarm run APP`: start an app on all robots; it goes on when the laptop is closed. `swarm stop APP` ends it."""

import argparse
import asyncio
import re
import secrets
from pathlib import Path

from swarm.errors import LocalError
from swarm.fleet import everyone
from swarm.fleet.everyone import Tell
from swarm.fleet.ssh import Host, Ssh
from swarm.fleet.units import SERVICES, unit
from swarm.keys import is_name

HELP = "start an app on all robots, over ssh (swarm stop APP ends it)"

APPS = "/var/lib/swarm/apps"
SETTINGS = "/etc/swarm/apps"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The app, and how far it runs."""
    parser.add_argument("app", help="the name of a built-in app, or a Python file of yours")
    parser.add_argument("--iterations", type=int, metavar="K", help="the last iteration (without: no last one)")
    parser.add_argument("--no-record", action="store_true", help="record nothing (docs/recordings.md)")
    everyone.add_arguments(parser, timeout_s=60)


def run(args: argparse.Namespace) -> int:
    """0 where it was started on every robot; on none of them where they have not all the same release."""
    name, source = _app(args.app)
    if args.iterations is not None and args.iterations < 0:
        raise LocalError(f"--iterations {args.iterations}: expected 0 or more")
    _, robots, ssh = everyone.chosen(args)
    asyncio.run(_same_release(ssh, robots, args.timeout))
    place = name if source is None else f"{APPS}/{name}.py"
    last = "" if args.iterations is None else f" --iterations {args.iterations}"
    # One number for this run on every robot: what an earlier run left behind has another.
    record = "" if args.no_record else " --record"
    settings = f"APP={place}\nARGUMENTS=--run {secrets.token_hex(8)}{last}{record}\n".encode()

    async def job(host: Host, tell: Tell) -> str:
        if source is not None:
            await _put(ssh, host, source, f"{APPS}/{name}.py")
        await _put(ssh, host, settings, f"{SETTINGS}/{name}.env")
        # Not waited for: an app is ready when it has its first measurement.
        await ssh.check(host, f"sudo -n systemctl restart --no-block {unit(name)}")
        return f"started {unit(name)}"

    return everyone.run(args, robots, job)


def _app(text: str) -> tuple[str, bytes | None]:
    """Its name, and its source where it is a file."""
    path = Path(text)
    name = path.stem if path.suffix == ".py" else text
    if not is_name(name) or name in SERVICES:
        raise LocalError(f"{text}: expected the name of an app, or a file with such a name: a-z, 0-9, _ and -")
    if path.suffix != ".py":
        return name, None
    try:
        return name, path.read_bytes()
    except OSError as error:
        raise LocalError(f"{path}: the app cannot be read: {error.strerror}") from None


async def _same_release(ssh: Ssh, robots: tuple[Host, ...], timeout_s: float) -> None:
    """Raises `LocalError` that names the robots where they differ: one swarm, one version of every protocol."""

    async def job(host: Host, tell: Tell) -> str:
        return (await ssh.check(host, "readlink /opt/swarm/current")).strip()

    outcomes = await everyone.each(robots, job, timeout_s, lambda *_: None)
    releases = {outcome.text.rpartition("/")[2] for outcome in outcomes if outcome.ok}
    if len(releases) > 1:
        rows = ", ".join(f"{o.robot} {re.sub('.*/', '', o.text)}" for o in outcomes if o.ok)
        raise LocalError(f"the robots have different releases ({rows}): swarm deploy the same to all of them first")


async def _put(ssh: Ssh, host: Host, data: bytes, place: str) -> None:
    """Write a file as root, whole or not at all."""
    await ssh.check(host, f"sudo -n sh -c 'cat > {place}.new && mv {place}.new {place}'", feed=[data])
