"""`swarm app param APP [NAME=VALUE]...`: look at an app's parameters, and change them while it runs.

Asked are the app's hosts on the buses that can be reached: those of a simulation that runs here, else this robot's own.
"""

import argparse
from collections.abc import Iterable, Mapping, Sequence

from swarm.app.parameters import value_of
from swarm.bus.zenoh_bus import Bus
from swarm.errors import LocalError
from swarm.messages import AppParameter, AppParameters, AppParametersSet, SetAppParameters
from swarm.messages.codec import Value, as_value
from swarm.messages.keys import is_name
from swarm.onboard.buses import buses
from swarm.onboard.buses.ask import PATIENCE, Answers, new_ticket, opened, request
from swarm.process.arguments import add_json, show
from swarm.process.terminal import columns

Known = Mapping[str, Mapping[str, AppParameter]]
"""Parameters by robot and name."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("app", metavar="APP", help="name of the app, e.g. consensus")
    parser.add_argument(
        "settings", nargs="*", metavar="[ROBOT.]NAME=VALUE", help="values to set (default: show the parameters)"
    )
    buses.add_arguments(parser)
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Show or set parameters; code 1 where a robot does not answer, or refuses."""
    wanted = settings_of(args)
    found = buses.directories_of(args)
    check_robots(wanted, list(found))
    with opened(found) as there:
        problems, changed = _change(there, args.app, wanted)
        known, later = _look(there, args.app, changed)
    if not known:
        raise LocalError(f"no app {args.app} answers on {', '.join(there)}: does it run? (swarm status)")
    silent = [robot for robot in there if robot not in known]
    values = {robot: {name: p.value for name, p in its.items()} for robot, its in known.items()}
    data = {"app": args.app, "parameters": values, "later": later, "silent": silent, "problems": problems}
    lines = [*table(known), *(f"{robot}: no answer" for robot in silent if robot not in problems), *problems.values()]
    lines += [f"{robot}: taken, and holds from the app's next step on" for robot in later]
    show(args, data, lines)
    return 1 if silent or problems else 0


def settings_of(args: argparse.Namespace) -> dict[str, dict[str, Value]]:
    """Return the wanted values by robot (or "" for all) and parameter; raises `LocalError`."""
    if not is_name(args.app):
        raise LocalError(f"{args.app[:40]!r} is no name of an app")
    found: dict[str, dict[str, Value]] = {}
    for word in args.settings:
        name, equals, text = word.partition("=")
        robot, _, parameter = name.rpartition(".")
        if not equals or not parameter.isidentifier():
            raise LocalError(f"{word[:60]!r} is no setting such as gain=0.5 or r2.gain=0.5")
        try:
            found.setdefault(robot, {})[parameter] = as_value(value_of(text))
        except LocalError as error:
            raise LocalError(f"{name}: {error}") from None
    return found


def check_robots(wanted: Iterable[str], there: Sequence[str]) -> None:
    """Raise `LocalError` where a value is wanted for a robot that is not asked; "" stands for all."""
    if unknown := {robot for robot in wanted if robot and robot not in there}:
        raise LocalError(f"no robot {min(unknown)!r} here, there are {', '.join(there)}")


def _change(
    there: Mapping[str, Bus], app: str, wanted: Mapping[str, Mapping[str, Value]]
) -> tuple[dict[str, str], dict[str, dict[str, Value]]]:
    """Set values. Return reasons for refusals, and the values that are set and taken, both by robot."""
    values = {robot: {**wanted.get("", {}), **wanted.get(robot, {})} for robot in there}
    requests = {robot: SetAppParameters(new_ticket(), each) for robot, each in values.items() if each}
    answers = request(there, requests, AppParametersSet, f"app/{app}", "parameters", PATIENCE)
    problems = {robot: answers[robot].problem for robot in sorted(answers) if answers[robot].problem}
    for robot in sorted(requests.keys() - answers.keys()):
        problems[robot] = f"{robot}: no answer to the change within {PATIENCE:g} s: look again whether it holds"
    return problems, {robot: values[robot] for robot, answer in answers.items() if not answer.problem}


def _look(there: Mapping[str, Bus], app: str, expected: Mapping[str, Mapping[str, Value]]) -> tuple[Known, list[str]]:
    """Ask for the parameters until they are as `expected`: an app takes other values between two steps.

    Returns the parameters, and the robots that do not have the expected ones yet.
    """
    answers = Answers(there, AppParameters, f"app/{app}", "parameters")

    def differs(robot: str, name: str, value: Value) -> bool:
        parameter = answers.newest[robot].parameters.get(name)
        return parameter is None or parameter.value != value

    def later() -> list[str]:
        return [
            robot
            for robot, values in sorted(expected.items())
            if robot in answers.newest and any(differs(robot, *each) for each in values.items())
        ]

    answers.wait(PATIENCE, lambda: len(answers.newest) == len(there) and not later())
    return {robot: answers.newest[robot].parameters for robot in sorted(answers.newest)}, later()


def table(known: Known) -> list[str]:
    """Return a table for people: a line for each parameter, a column for each robot."""
    rows = [("parameter", *known, "may be")]
    for name in dict.fromkeys(name for parameters in known.values() for name in parameters):
        some = next(parameters[name] for parameters in known.values() if name in parameters)
        values = (_shown(parameters[name].value) if name in parameters else "-" for parameters in known.values())
        rows.append((name + ("" if some.live else " (fixed)"), *values, some.expected))
    return columns(rows)


def _shown(value: Value) -> str:
    return str(value).lower() if isinstance(value, bool) else str(value)
