"""`swarm logs [SERVICE...]`: what the services of all robots have written to their journals, or to the log files of a
simulation that runs here.

`swarm logs RUN` tells what apps have printed and logged in a recorded run.
"""

import argparse
import sys
import time
from collections import Counter
from collections.abc import Mapping
from pathlib import Path

from laptop.fleet.ssh import everyone, robot_command
from laptop.fleet.ssh.ssh import Host
from laptop.fleet.units import JOURNAL_OF_ALL, SERVICES, unit
from sim.processes.progress import said
from swarm.config.find import find
from swarm.errors import LocalError
from swarm.messages import AppLog
from swarm.messages.keys import is_name
from swarm.process.arguments import show, whole
from swarm.process.terminal import write_lines
from swarm.process.text import printable
from swarm.recording.reader import SUFFIX
from swarm.recording.run import Run

HELP = "show the logs of all robots, or of the apps in a recorded run"

FOREVER_S = 1e9
LINES = 20
WANTED = "a service, an app or a run"
MOST_RUNS = 8
"""Runs that an error names."""

FOLLOW_S = 0.3
"""Seconds between two looks into the log files of a simulation."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "services",
        nargs="*",
        metavar="SERVICE|RUN",
        help="services or apps (default: all); or a run's folder or recording, then apps",
    )
    parser.add_argument("-f", "--follow", action="store_true", help="also show new lines, until Ctrl-C")
    text = f"number of lines of each robot ({LINES}; of a recorded run all)"
    parser.add_argument("-n", "--lines", type=whole(0), help=text)
    robot_command.add_simulation(parser)
    everyone.add_arguments(parser, timeout_s=30)


def run(args: argparse.Namespace) -> int:
    """Print lines as they come, each with its robot's name."""
    if args.services and _is_run(args.services[0]):
        return _of_run(args)
    args.lines = LINES if args.lines is None else args.lines
    if args.services and not is_name(args.services[0]):
        raise LocalError(f"{args.services[0]}: there is no such run{_runs(Path(args.services[0]).parent)}")
    if args.follow and args.json:
        raise LocalError("--follow and --json do not go together: there is no end to report")
    if (there := robot_command.simulated(args)) is not None:
        return _simulated(args, there)
    _known(args)
    config, robots, ssh = everyone.recipients(args)
    everyone.refuse_robots(args.services, config.names, WANTED)
    which = " ".join(f"--unit={name}" for name in map(unit, args.services)) or JOURNAL_OF_ALL
    command = f"sudo -n journalctl --quiet --no-pager --output=short-iso --lines={args.lines} {which}"
    what = ", ".join(args.services) or "any service"
    if args.follow:
        command, args.timeout = command + " --follow", FOREVER_S

    async def job(host: Host, tell: everyone.ReportProgress) -> str:
        count = await ssh.follow(host, command, tell)
        return f"{count} lines" if count or not args.lines else f"nothing is logged there by {what}"

    return everyone.run(args, robots, job)


def _is_run(word: str) -> bool:
    """Return whether a word means a run: a path that is there or, of what can be an app, a folder with recordings.
    `./mesh` is a run in the folder mesh."""
    if is_name(word):
        return word not in SERVICES and any(Path(word).glob(f"*{SUFFIX}"))
    return Path(word).exists()


def _known(args: argparse.Namespace) -> None:
    """Raise `LocalError` where a name can only be meant as a run: there are no robots here whose services it names."""
    if not args.services or args.config is not None or find() is not None:
        return
    raise LocalError(
        f"{args.services[0]}: there is no such run here{_runs(Path())}. The name may also be that of a service or app "
        f"({', '.join(SERVICES)}, ...), where a swarm.toml names the robots or a simulation runs"
    )


def _runs(place: Path) -> str:
    """Return the recorded runs in a folder as the rest of a message."""
    files = sorted(place.glob(f"*/*{SUFFIX}")) + sorted(place.glob(f"*/*/*{SUFFIX}"))
    found = list(dict.fromkeys(str(file.parent) for file in files))[:MOST_RUNS]
    return f"; there are: {', '.join(found)}" if found else "; swarm fetch brings those of the robots"


def _of_run(args: argparse.Namespace) -> int:
    """Print what apps have printed and logged, in the order of time; of these apps and robots alone where some are
    named."""
    if args.follow:
        raise LocalError(f"--follow: {args.services[0]} is recorded, nothing new comes")
    recorded, apps = Run(Path(args.services[0])), set(args.services[1:])
    there = {topic.split("/")[3] for topic in recorded.topics if "/app/" in topic}
    if strange := apps - there:
        everyone.refuse_robots(strange, recorded.robots, "an app")
        raise LocalError(f"{recorded.path}: no app {min(strange)} is recorded; there are: {', '.join(sorted(there))}")
    wanted = set(args.robots or recorded.robots)
    if odd := wanted - set(recorded.robots):
        raise LocalError(f"{recorded.path}: no robot {min(odd)} is recorded; there are: {', '.join(recorded.robots)}")
    lines = []
    for sample in recorded.samples("swarm/*/app/*/log"):
        _, robot, _, app, _ = sample.topic.split("/")
        if robot in wanted and (not apps or app in apps):
            message = sample.message
            lines.append((robot, AppLog(sample.t, str(message.get("level", "")), str(message.get("text", "")))))
    if args.lines is not None:
        lines = _newest(lines, args.lines)
    rows = [{"robot": robot, "t": line.t, "level": line.level, "text": line.text} for robot, line in lines]
    text = [said(robot, line) for robot, line in lines] or ["no app has printed or logged anything in this run"]
    damage = list(recorded.damage)
    show(args, {"lines": rows, "damage": damage}, [*(f"note: {each}" for each in damage), *text])
    return 0


def _newest(lines: list[tuple[str, AppLog]], count: int) -> list[tuple[str, AppLog]]:
    """Return the last `count` lines of each robot."""
    left, kept = Counter[str](), []
    for robot, line in reversed(lines):
        left[robot] += 1
        if left[robot] <= count:
            kept.append((robot, line))
    return kept[::-1]


def _simulated(args: argparse.Namespace, there: Mapping[str, Path]) -> int:
    """Print the log files of simulated robots' services; raises `LocalError` for one that no robot has."""
    wanted = {f"{name}.log" if name in SERVICES else f"app.{name}.log": name for name in args.services}
    written = {path.name for runtime in there.values() for path in runtime.glob("*.log")}
    if odd := [name for file, name in wanted.items() if file not in written]:
        everyone.refuse_robots(odd, there, WANTED)
        names = ", ".join(sorted(name.removesuffix(".log").removeprefix("app.") for name in written))
        raise LocalError(f"{odd[0]}: no robot of the simulation that runs here has such a log; there are: {names}")
    files = [
        (name, path)
        for name, runtime in there.items()
        for path in sorted(runtime.glob("*.log"))
        if not wanted or path.name in wanted
    ]
    found: dict[str, list[str]] = {name: [] for name in there}
    places: dict[Path, int] = {}
    for name, path in files:
        text = path.read_text(errors="replace")
        places[path] = path.stat().st_size
        found[name] += text.splitlines()[-args.lines :] if args.lines else []
    shown = [f"{name}: {printable(line)}" for name, lines in found.items() for line in lines]
    if not shown and not args.follow:
        shown = [f"nothing is logged yet by {', '.join(args.services) or 'any service'} of {', '.join(there)}"]
    show(args, {"robots": {name: {"ok": True, "lines": lines} for name, lines in found.items()}}, shown)
    while args.follow:
        sys.stdout.flush()
        time.sleep(FOLLOW_S)
        for name, path in files:
            with path.open("rb") as file:
                file.seek(places[path])
                data = file.read()
            whole = data[: data.rfind(b"\n") + 1]
            places[path] += len(whole)
            write_lines([f"{name}: {printable(line)}" for line in whole.decode(errors="replace").splitlines()])
    return 0
