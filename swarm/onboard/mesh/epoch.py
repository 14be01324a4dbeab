"""`swarm mesh epoch show|drop|add|renew`: who is in an app's lockstep, and changing that by an operator's word.

Any one member takes the order; the robots agree on it among themselves (docs/explanation/epochs.md).
"""

import argparse
from collections.abc import Iterable, Mapping
from dataclasses import asdict
from functools import partial

from swarm.errors import LocalError
from swarm.messages import AppEpoch, SetAppEpoch
from swarm.messages.keys import is_name, key
from swarm.onboard.buses import buses
from swarm.onboard.buses.ask import PATIENCE, Answers, Views, new_ticket, opened
from swarm.onboard.command_line import add_verb
from swarm.process.arguments import add_json, number, show

HELP = "show or change which robots an app's lockstep runs on"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare `show`, `drop ROBOT...`, `add ROBOT...` or `renew`, then options."""
    verbs = parser.add_subparsers(dest="verb", required=True, metavar="show|drop|add|renew")
    verb = partial(add_verb, verbs, epilog=parser.epilog)
    look = verb("show", "show the members of the run as each robot knows them; exit code 1 if members differ")
    drop = verb("drop", "continue the run without these robots until they are added again")
    add = verb("add", "admit robots again that `drop` has removed")
    renew = verb("renew", "form a new epoch of all robots that are present, with the links in force")
    for each, text in ((drop, "robot to continue without"), (add, "robot to admit again")):
        each.add_argument("which", nargs="+", metavar="ROBOT", help=text)
    for each in (drop, add, renew):
        each.add_argument(
            "--force",
            action="store_true",
            help="continue even without a majority of the members. Use it only if the "
            "others are known to have stopped; otherwise both parts continue",
        )
        each.add_argument(
            "--timeout", type=number(0), default=10.0, metavar="S", help="seconds to wait for the result (10)"
        )
    for each in (look, drop, add, renew):
        each.add_argument("--app", required=True, metavar="NAME", help="name of the app, e.g. consensus")
        buses.add_arguments(each)
        add_json(each)


def run(args: argparse.Namespace) -> int:
    """Show or change an epoch; code 1 where members tell different epochs, or the change has not come about in time."""
    if not is_name(args.app):
        raise LocalError(f"--app {args.app}: expected the name of an app")
    with opened(buses.directories_of(args)) as found:
        answers = Answers(found, AppEpoch, f"app/{args.app}", "epoch")
        if not answers.wait(PATIENCE, lambda: bool(answers.newest)):
            raise LocalError(
                f"no robot tells who is in {args.app}: {', '.join(found)} ({PATIENCE:g} s); "
                "does the app run? (swarm status)"
            )
        problem = ""
        if args.verb == "show":
            answers.wait(PATIENCE, lambda: len(answers.newest) == len(found))
        else:
            problem = _order(answers, args)
    done = not problem and _agree(answers.newest)
    told = {name: asdict(answers.newest[name]) if name in answers.newest else None for name in found}
    lines = [*([problem] if problem else []), *table(answers)]
    show(args, {"done": done, "problem": problem, "robots": told}, lines)
    return 0 if done else 1


def table(answers: Answers[AppEpoch]) -> list[str]:
    """Return the epoch of each robot as lines for people."""
    lines = []
    for name in answers.buses:
        epoch = answers.newest.get(name)
        if epoch is None:
            lines.append(f"{name}  silent")
            continue
        marks = [f"sent away: {' '.join(epoch.away)}"] if epoch.away else []
        marks += ["without a majority"] if epoch.forced else []
        more = f"  ({'; '.join(marks)})" if marks else ""
        lines.append(f"{name}  epoch {epoch.epoch} from iteration {epoch.k} on: {' '.join(epoch.members)}{more}")
    return lines


def _order(answers: Answers[AppEpoch], args: argparse.Namespace) -> str:
    """Give the order to one robot. Return what is wrong where its app has not followed in time."""
    known, which = answers.newest, tuple(getattr(args, "which", ()))
    _check(answers, which)

    def asked() -> str | None:
        so_far = dict(known)
        members = {name for epoch in so_far.values() for name in epoch.members}
        return next((name for name in so_far if name in members and name not in which), None)

    answers.wait(PATIENCE, lambda: asked() is not None)  # the one that is dropped may be the first to answer
    if (name := asked()) is None:
        raise LocalError(f"none of {', '.join(known)} is in {args.app}: ask a robot that is")
    before = known[name]
    drop = which if args.verb == "drop" else ()
    add = which if args.verb == "add" else ()
    wish = SetAppEpoch(new_ticket(), drop, add, args.force)

    def done() -> bool:
        now = known[name]
        return now.epoch > before.epoch and not set(drop) & set(now.members) and not set(add) & set(now.away)

    def order() -> None:
        answers.buses[name].publish(key(name, f"app/{args.app}", "set", "epoch"), wish, urgent=True)

    if not answers.wait(args.timeout, done, order):
        most = f"more than half of its {len(before.members)} members must agree"
        return f"{name} has not followed within {args.timeout:g} s: {most}"
    answers.wait(PATIENCE, lambda: _agree(known))
    return ""


def _check(answers: Answers[AppEpoch], which: Iterable[str]) -> None:
    """Raise `LocalError` for a name that no robot of the swarm has: an app would drop it, and nothing would change."""
    known = {name for epoch in dict(answers.newest).values() for name in (*epoch.members, *epoch.away)}
    if not (strange := [name for name in which if name not in known]):
        return
    views = Views()
    for name, bus in answers.buses.items():
        views.ask(name, bus, PATIENCE)
    with views.changed:
        views.changed.wait_for(lambda: bool(views.robots), PATIENCE)
    there = sorted(known | views.best().keys())
    if strange := [name for name in strange if name not in there]:
        raise LocalError(f"no robot {strange[0]!r} in the swarm, there are {', '.join(there)}")


def _agree(told: Mapping[str, AppEpoch]) -> bool:
    """Return whether all robots that count themselves among the members tell the same epoch.

    A robot that knows that it was sent away need not hear of later epochs.
    """
    so_far = dict(told)  # answers come on another thread
    return len({epoch.frames for name, epoch in so_far.items() if name in epoch.members}) <= 1
