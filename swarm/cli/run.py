"""`swarm run APP`: start an app on all robots; it goes on when the laptop is closed. `swarm stop APP` ends it."""

import argparse
import asyncio
import hashlib
import re
import secrets
from pathlib import Path

from swarm import conduct
from swarm.config import Config
from swarm.errors import AppError, LocalError, RemoteError
from swarm.fleet import everyone, versions
from swarm.fleet.everyone import Tell
from swarm.fleet.ssh import Host, HostError, Ssh
from swarm.fleet.units import SERVICES, unit
from swarm.fleet.versions import Versions
from swarm.keys import is_name
from swarm.settings import on_top, parse

HELP = "start an app on all robots, over ssh (swarm stop APP ends it)"

APPS = "/var/lib/swarm/apps"
SETTINGS = "/etc/swarm/apps"

_PLAIN = re.compile(r"[A-Za-z0-9_.,:+=\[\]/-]+")
"""What a setting may hold: systemd splits its arguments at spaces, and knows quotes."""

_START = """set -e; umask 022
[ -z "{folder}" ] || {{ mkdir -p {folder}; head -c {size} >{folder}/new; mv {folder}/new {folder}/{name}.py; }}
cat >{settings}.new; mv {settings}.new {settings}
systemctl restart --no-block {unit}
find {apps} -mindepth 1 -maxdepth 1 -name "{name}-????????????" ! -path "{folder}" -exec rm -rf {{}} +"""
"""For the robot's shell, in single quotes: the app lies in a folder that is named by its content, and one renamed file
says both where it is and how it is run. Whatever breaks before that has changed nothing."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The app, and how it runs."""
    parser.add_argument("app", help="the name of a built-in app, or a Python file of yours")
    parser.add_argument("--iterations", type=int, metavar="K", help="the last iteration (without: no last one)")
    conduct.add_arguments(parser)
    parser.add_argument(
        "--set", dest="settings", action="append", default=[], metavar="[ROBOT.]NAME=VALUE",
        help="a parameter of the app, of all robots or one: --set gain=0.5 --set r2.value=3",
    )  # fmt: skip
    parser.add_argument("--no-record", action="store_true", help="keep no recording (swarm fetch brings them)")
    parser.add_argument("--force", action="store_true", help="even where release, config or firmware differ")
    everyone.add_arguments(parser, timeout_s=60)


def run(args: argparse.Namespace) -> int:
    """0 where it was started on every robot; on none of them where they do not all run the same."""
    name, source = _app(args.app)
    if args.iterations is not None and args.iterations < 0:
        raise LocalError(f"--iterations {args.iterations}: expected 0 or more")
    config, robots, ssh = everyone.chosen(args)
    _check_settings(args.settings, config, name)
    if not args.force:
        asyncio.run(_check_versions(ssh, robots, config, args.timeout))
    digest = "" if source is None else hashlib.sha256(source).hexdigest()[:12]
    folder = f"{APPS}/{name}-{digest}" if source is not None else ""
    # One number for this run on every robot: what an earlier run left behind has another.
    arguments = ["--run", secrets.token_hex(8)]
    if not args.no_record:
        arguments.append("--record")
    if args.iterations is not None:
        arguments += ["--iterations", str(args.iterations)]
    arguments += conduct.of(args).words
    for setting in args.settings:
        arguments += ["--set", setting]
    place = name if source is None else f"{folder}/{name}.py"
    settings = f"APP={place}\nARGUMENTS={' '.join(arguments)}\n".encode()
    script = _START.format(
        folder=folder, size=len(source or b""), name=name, settings=f"{SETTINGS}/{name}.env", unit=unit(name), apps=APPS
    )

    async def job(host: Host, tell: Tell) -> str:
        # Not waited for: an app is ready when it has its first measurement.
        await ssh.check(host, f"sudo -n sh -c '{script}'", feed=[source or b"", settings])
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


def _check_settings(settings: list[str], config: Config, name: str) -> None:
    """What can be known here is said here: the robots' own word would come when the app has not started."""
    for text in settings:
        if not _PLAIN.fullmatch(text):
            raise LocalError(f"--set {text}: no spaces and quotes in it, please; write it into swarm.toml")
    try:
        on_top(config.app(name), map(parse, settings), config.names)
    except AppError as error:
        raise LocalError(f"--set: {error}") from None


async def _check_versions(ssh: Ssh, robots: tuple[Host, ...], config: Config, timeout_s: float) -> None:
    """Raises `LocalError` that names the robots where they differ: one swarm, one version of everything."""
    found: dict[str, Versions] = {}

    async def job(host: Host, tell: Tell) -> str:
        try:
            found[host.robot] = versions.parse(await ssh.check(host, versions.question(host.robot)))
        except RemoteError as error:
            raise HostError(str(error)) from None
        return ""

    await everyone.each(robots, job, timeout_s, lambda *_: None)  # who is not there is told by the start
    here = hashlib.sha256(config.path.read_bytes()).hexdigest()
    if found and (wrong := versions.differences(found, here)):
        raise LocalError(f"the robots have {'; '.join(wrong)} (or --force)")
