"""`swarm run APP`: start an app on all robots. It goes on without the laptop; `swarm services stop APP` ends it."""

import argparse
import asyncio
from pathlib import Path

from laptop.fleet import apps, everyone
from laptop.fleet.everyone import ReportProgress
from laptop.fleet.ssh import Host, Ssh
from laptop.fleet.versions import Versions
from swarm.app import run_options
from swarm.config import Config
from swarm.errors import LocalError

HELP = "start an app on all robots, over ssh (swarm services stop APP ends it)"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The app, and how it runs."""
    parser.add_argument("app", help="the name of a built-in app, or a Python file of yours")
    parser.add_argument("--iterations", type=int, metavar="K", help="the last iteration (without: no last one)")
    run_options.add_arguments(parser)
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
    apps.check_settings(args.settings, config, name)
    if not args.force:
        asyncio.run(_check_versions(ssh, robots, config, args.timeout))
    arguments = [] if args.no_record else ["--record"]
    start = apps.AppStart(name, source, arguments=[*arguments, *run_options.of(args).arguments], settings=args.settings)

    async def job(host: Host, tell: ReportProgress) -> str:
        return await start.on(ssh, host)

    return everyone.run(args, robots, job)


def _app(text: str) -> tuple[str, bytes | None]:
    """Its name, and its source where it is a file."""
    path = Path(text)
    name = path.stem if path.suffix == ".py" else text
    apps.check_name(name, text)
    if path.suffix != ".py":
        return name, None
    try:
        return name, path.read_bytes()
    except OSError as error:
        raise LocalError(f"{path}: the app cannot be read: {error.strerror}") from None


async def _check_versions(ssh: Ssh, robots: tuple[Host, ...], config: Config, timeout_s: float) -> None:
    """Raises `LocalError` that names the robots where they differ."""
    found: dict[str, Versions] = {}

    async def job(host: Host, tell: ReportProgress) -> str:
        found[host.robot] = await apps.ask_versions(ssh, host)
        return ""

    await everyone.each(robots, job, timeout_s, lambda *_: None)  # who is not there is told by the start
    if wrong := apps.differences(found, config):
        raise LocalError(f"{wrong} (or --force)")
