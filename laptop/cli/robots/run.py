"""`swarm run APP`: start an app on all robots. It goes on without the laptop; `swarm services stop APP` ends it."""

import argparse
from pathlib import Path

from laptop.fleet import apps, everyone
from laptop.fleet.everyone import ReportProgress
from laptop.fleet.ssh import Host
from swarm.app import run_options
from swarm.errors import LocalError
from swarm.onboard.arguments import whole

HELP = "start an app on all robots, over ssh (swarm services stop APP ends it)"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The app, and how it runs."""
    parser.add_argument("app", help="the name of a built-in app, or a Python file of yours")
    parser.add_argument("--iterations", type=whole(0), metavar="K", help="the last iteration (without: no last one)")
    run_options.add_arguments(parser)
    parser.add_argument(
        "--set",
        dest="settings",
        action="append",
        default=[],
        metavar="[ROBOT.]NAME=VALUE",
        help="a parameter of the app, of all robots or one: --set gain=0.5 --set r2.value=3",
    )
    parser.add_argument("--no-record", action="store_true", help="keep no recording (swarm fetch brings them)")
    parser.add_argument("--force", action="store_true", help="even where release, config or firmware differ")
    everyone.add_arguments(parser, timeout_s=60)


def run(args: argparse.Namespace) -> int:
    """0 where it was started on every robot; on none of them where they do not all run the same."""
    name, source = _app(args.app)
    config, robots, ssh = everyone.chosen(args)
    apps.check_settings(args.settings, config, name)
    if not args.force:
        # Who is not there is told by the start.
        _, found = everyone.gather(robots, lambda host: apps.ask_versions(ssh, host), args.timeout)
        if wrong := apps.differences(found, config):
            raise LocalError(f"{wrong} (or --force)")
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
