"""`swarm app param APP [NAME=VALUE]...`: look at an app's parameters, and change them while it runs.

Asked are the app's hosts on the buses that can be reached: those of a simulation that runs here, else this robot's own.
With `--fleet` it is done on every robot of the configuration, over ssh.
"""

import argparse
import contextlib
import json
import os
import shlex
import threading
from collections.abc import Callable, Mapping
from pathlib import Path

from laptop.cli.mesh.survey import opened
from laptop.fleet import everyone
from laptop.fleet.everyone import ReportProgress
from laptop.fleet.ssh import Host, HostError, last_words
from swarm import clock
from swarm.app.parameters import value_of
from swarm.bus.zenoh_bus import Bus
from swarm.errors import LocalError, PayloadError
from swarm.messages import AppParameter, AppParameters, AppParametersSet, SetAppParameters
from swarm.messages.codec import Value, decode
from swarm.messages.keys import is_name, key
from swarm.onboard import buses
from swarm.process.terminal import write_lines

HELP = "show or change parameters of an app that runs"

ROUND = 0.3
"""s between two questions, and until a request without an answer is repeated."""
COMMAND = "sudo -n /opt/swarm/current/bin/swarm app param"
"""On a robot."""
ANSWER = 3.0
"""s within which a host that is there answers."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """`APP [[ROBOT.]NAME=VALUE]...`."""
    parser.add_argument("app", help="name of the app, e.g. consensus")
    parser.add_argument("settings", nargs="*", metavar="[ROBOT.]NAME=VALUE", help="none = show them")
    parser.add_argument("--fleet", action="store_true", help="on the robots of the config, over ssh")
    parser.add_argument("--run-dir", type=Path, metavar="DIR", help="of a simulation started with one")
    everyone.add_arguments(parser, timeout_s=20)


def run(args: argparse.Namespace) -> int:
    """Code 1 where a robot does not answer, or refuses."""
    if not is_name(args.app):
        raise LocalError(f"{args.app[:40]!r} is no name of an app")
    wanted = _settings(args.settings)
    if args.fleet:
        return _everywhere(args)
    args.robot = None
    found = _chosen(buses.find(args), args.robots)
    if unknown := {robot for robot in wanted if robot and robot not in found}:
        raise LocalError(f"no robot {min(unknown)!r} here, there are {', '.join(found)}")
    with opened(found) as there:
        hosts = Hosts(there, args.app)
        problems = hosts.change(wanted) if wanted else {}
        later = hosts.look(hosts.changed)
    if not hosts.known:
        raise LocalError(f"no app {args.app} answers on {', '.join(there)}: does it run? (swarm status)")
    silent = [robot for robot in there if robot not in hosts.known]
    if args.json:
        values = {robot: {name: p.value for name, p in known.items()} for robot, known in hosts.known.items()}
        lists = {"later": later, "silent": silent, "problems": problems}
        print(json.dumps({"app": args.app, "parameters": values, **lists}))
    else:
        write_lines(table(hosts.known))
        for robot in silent:
            print(f"{robot}: no answer")
        for problem in problems.values():
            write_lines([problem])
        for robot in later:
            print(f"{robot}: taken, and holds from the app's next step on")
    return 1 if silent or problems else 0


class Hosts:
    """The hosts of one app on several buses."""

    def __init__(self, there: Mapping[str, Bus], app: str) -> None:
        self._there = there
        self._service = f"app/{app}"
        self._changed = threading.Condition()
        self.known: dict[str, dict[str, AppParameter]] = {}
        """Parameters by robot and name: of the robots that have answered."""
        self.changed: dict[str, dict[str, Value]] = {}
        """What has been set and taken, by robot."""

    def look(self, expected: Mapping[str, Mapping[str, Value]]) -> list[str]:
        """Ask for the parameters as they are now, and again until they are as `expected`: an app takes others between
        two steps. Given back are the robots that have not by then."""
        self.known.clear()

        def later() -> list[str]:
            return [
                robot
                for robot, values in sorted(expected.items())
                if robot in self.known and any(self._differs(robot, name, values[name]) for name in values)
            ]

        def ask() -> None:
            with self._changed:
                missing = (self._there.keys() - self.known.keys()) | set(later())
            for robot in missing:
                take = _taker(AppParameters, lambda found, robot=robot: self._take(robot, found))
                self._there[robot].ask(key(robot, self._service, "parameters"), take)

        self._until(lambda: len(self.known) == len(self._there) and not later(), ask)
        with self._changed:
            self.known = {robot: self.known[robot] for robot in sorted(self.known)}
            return later()

    def change(self, wanted: Mapping[str, Mapping[str, Value]]) -> dict[str, str]:
        """Set values, those under "" on all robots; why not, by robot."""
        requests = {}
        answers: dict[str, str] = {}
        for robot, bus in self._there.items():
            values = {**wanted.get("", {}), **wanted.get(robot, {})}
            if not values:
                continue
            requests[robot] = SetAppParameters(f"{os.getpid()}-{os.urandom(4).hex()}", values)

            def take(answer: AppParametersSet, robot: str = robot) -> None:
                if answer.ticket == requests[robot].ticket:
                    with self._changed:
                        answers.setdefault(robot, answer.problem)
                        self._changed.notify_all()

            bus.subscribe(key(robot, self._service, "parameters_set"), _taker(AppParametersSet, take))

        def ask() -> None:
            for robot, request in requests.items():
                if robot not in answers:
                    self._there[robot].publish(key(robot, self._service, "set", "parameters"), request, urgent=True)

        self._until(lambda: len(answers) == len(requests), ask)
        self.changed = {robot: requests[robot].parameters for robot, problem in answers.items() if not problem}
        return {robot: answers[robot] for robot in sorted(answers) if answers[robot]}

    def _differs(self, robot: str, name: str, value: Value) -> bool:
        parameter = self.known[robot].get(name)
        return parameter is None or parameter.value != value

    def _take(self, robot: str, found: AppParameters) -> None:
        with self._changed:
            self.known[robot] = found.parameters
            self._changed.notify_all()

    def _until(self, enough: Callable[[], bool], ask: Callable[[], None]) -> None:
        end = clock.now() + ANSWER
        while clock.now() < end:
            ask()
            with self._changed:
                if self._changed.wait_for(enough, ROUND):
                    return


def table(known: Mapping[str, Mapping[str, AppParameter]]) -> list[str]:
    """What people read: a line for each parameter, a column for each robot."""
    rows = [("parameter", *known, "may be")]
    for name in dict.fromkeys(name for parameters in known.values() for name in parameters):
        some = next(parameters[name] for parameters in known.values() if name in parameters)
        values = (_shown(parameters[name].value) if name in parameters else "-" for parameters in known.values())
        rows.append((name + ("" if some.live else " (fixed)"), *values, some.expected))
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    return ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]


def _shown(value: Value) -> str:
    return str(value).lower() if isinstance(value, bool) else str(value)


def _taker(kind: type, take: Callable[..., None]) -> Callable[[str, bytes], None]:
    def handle(name: str, payload: bytes) -> None:
        with contextlib.suppress(PayloadError):
            take(decode(kind, payload, name))

    return handle


def _settings(words: list[str]) -> dict[str, dict[str, Value]]:
    """Values by robot (or "") and parameter."""
    found: dict[str, dict[str, Value]] = {}
    for word in words:
        name, equals, text = word.partition("=")
        robot, _, parameter = name.rpartition(".")
        if not equals or not parameter.isidentifier():
            raise LocalError(f"{word[:60]!r} is no setting such as gain=0.5 or r2.gain=0.5")
        found.setdefault(robot, {})[parameter] = value_of(text)
    return found


def _chosen(found: dict[str, Path], wanted: str | None) -> dict[str, Path]:
    if wanted is None:
        return found
    names = wanted.split(",")
    if unknown := [name for name in names if name not in found]:
        raise LocalError(f"no robot {unknown[0]!r} here, there are {', '.join(found)}")
    return {name: found[name] for name in names}


def _everywhere(args: argparse.Namespace) -> int:
    _, robots, ssh = everyone.chosen(args)

    async def job(host: Host, tell: ReportProgress) -> str:
        mine = [word.removeprefix(f"{host.robot}.") for word in args.settings]
        words = [word for word in mine if "." not in word.partition("=")[0]]
        if args.settings and not words:
            return "nothing to change"
        done = await ssh.run(host, f"{COMMAND} {shlex.join([args.app, *words])}", on_line=tell)
        if done.code != 0:
            raise HostError(last_words(done.err) or f"exit code {done.code}")
        return ""

    return everyone.run(args, robots, job)
