"""`swarm run APP...`: start apps on all robots. They go on without the laptop; `swarm services stop APP` ends one."""

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from laptop.fleet import apps
from laptop.fleet.ssh import everyone
from laptop.fleet.ssh.ssh import Host
from services.apps import sources
from sim.scenario.quantities import add_app_settings
from swarm.app import run_options
from swarm.config import Config
from swarm.errors import LocalError
from swarm.onboard.command_line import complain
from swarm.process.arguments import whole

HELP = "start apps on all robots, over ssh (swarm services stop APP ends one)"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the apps, and how they run, in the words of `swarm sim APP`."""
    parser.add_argument("app", nargs="+", metavar="APP", help="names of built-in apps, or Python files of yours")
    add_app_settings(parser)
    parser.add_argument("--iterations", type=whole(1), metavar="K", help="end after K iterations (default: no end)")
    run_options.add_arguments(parser)
    parser.add_argument("--no-record", action="store_true", help="write no recording")
    parser.add_argument("--force", action="store_true", help="start even if release, config or firmware differ")
    everyone.add_arguments(parser, timeout_s=60)


def run(args: argparse.Namespace) -> int:
    """Start the apps, on no robot where robots do not all run the same. Return 0 where all apps have a first state on
    every robot."""
    found = dict(map(_app, args.app))
    # The comparison below finds other names, and without --force nothing is started on any robot.
    config, robots, ssh = everyone.recipients(args, addressed=True, named=False)
    settings = settings_of(args, list(found))
    for name in found:
        apps.check_settings(settings[name], config, name)
    if not args.force:
        # The start tells which robots are not there.
        _, versions = everyone.gather(
            robots, lambda host: apps.ask_versions(ssh, host), min(args.timeout, everyone.ASK_S)
        )
        if wrong := apps.differences(versions, config):
            raise LocalError(f"{wrong} (or --force)")
    _warn(args.app, config)
    record = [] if args.no_record else ["--record"]
    first, how = next(iter(found)), run_options.of(args)
    beside = replace(how, last=None, rule=None)  # the first app decides when the run ends, as in `swarm sim`
    arguments = {name: [*record, *(how if name == first else beside).arguments] for name in found}
    starts = [
        apps.AppStart(name, files, arguments=arguments[name], settings=settings[name]) for name, files in found.items()
    ]

    async def job(host: Host, _: everyone.ReportProgress) -> str:
        return ", ".join([await start.until_first_state(ssh, host) for start in starts])

    return everyone.run(args, robots, job)


def settings_of(args: argparse.Namespace, names: Sequence[str]) -> dict[str, list[str]]:
    """Return the settings of each app, as `swarm sim` understands them. Raises `LocalError` for an app that is not
    started."""
    first: list[str] = []
    if args.algorithm is not None:
        first.append(f"algorithm={args.algorithm}")
    if args.step_size is not None:
        first.append(f"step_size={args.step_size * 1e4!r}")  # 1/cm^2 in 1/m^2
    found = {name: (first if name == names[0] else []) for name in names}
    for given in args.settings:
        name = given.app or names[0]
        if name not in found:
            raise LocalError(f"--set {name}/{given.setting.text}: there is no app {name!r}, but {', '.join(names)}")
        found[name].append(given.setting.text)
    return found


def _app(text: str) -> tuple[str, Mapping[str, bytes] | None]:
    """Return an app's name, and its files where it is one of the user."""
    path = Path(text)
    name = path.stem if path.suffix == ".py" else text
    apps.check_name(name, text)
    if path.suffix != ".py":
        return name, None
    try:
        return name, sources.of_app(path.resolve())
    except OSError as error:
        raise LocalError(f"{path}: the app cannot be read: {error.strerror}") from None


def _warn(given: Sequence[str], config: Config) -> None:
    """Say what robots lack of what the apps import."""
    from sim.scenario import imports

    for each in given:
        if each.endswith(".py"):
            for line in imports.missing_imports(str(Path(each).resolve()), config.packages):
                complain("swarm", f"warning: {line}")
