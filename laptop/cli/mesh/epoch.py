"""`swarm mesh epoch show|drop|add|renew`: who is in an app's lockstep, and changing that by an operator's word.

Any one member takes the order; the robots agree on it among themselves (docs/lockstep.md).
"""

import argparse
import contextlib
import os
import threading
from collections.abc import Callable, Mapping
from functools import partial

from laptop.cli.mesh.survey import opened
from swarm import clock
from swarm.bus.zenoh_bus import Bus
from swarm.errors import LocalError, PayloadError
from swarm.messages import AppEpoch, SetAppEpoch
from swarm.messages.codec import decode
from swarm.messages.keys import is_name, key
from swarm.onboard import buses
from swarm.process.terminal import write_lines

HELP = "show or change which robots an app's lockstep runs on"

ROUND = 0.3
"""s between two questions."""

ANSWER = 3.0
"""s within which a host that is there answers."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """`show`, `drop ROBOT...`, `add ROBOT...` or `renew`, then options."""
    verbs = parser.add_subparsers(dest="verb", required=True, metavar="show|drop|add|renew")
    show = verbs.add_parser("show", help="the members on each robot; code 1 where robots tell different ones")
    drop = verbs.add_parser("drop", help="go on without these robots, until they are added again")
    add = verbs.add_parser("add", help="take robots in again that were dropped so")
    renew = verbs.add_parser("renew", help="take in who is there, with the links in force, and leave out who is not")
    for each in (drop, add):
        each.add_argument("robots", nargs="+", metavar="ROBOT")
    for each in (drop, add, renew):
        each.add_argument("--force", action="store_true", help="even without a majority of the members: only where the "
                          "others are known to have stopped, else both parts go on")  # fmt: skip
        each.add_argument("--timeout", type=float, default=10.0, metavar="S", help="seconds to wait for it (10)")
    for each in (show, drop, add, renew):
        each.add_argument("--app", required=True, metavar="NAME")
        buses.add_arguments(each)


def run(args: argparse.Namespace) -> int:
    """Code 1 where robots tell different epochs, or the change has not come about in time."""
    if not is_name(args.app):
        raise LocalError(f"--app {args.app}: expected the name of an app")
    with opened(buses.find(args)) as found:
        view = EpochView(found, args.app)
        if not view.wait(ANSWER, lambda: bool(view.epochs)):
            raise LocalError(f"no robot tells who is in {args.app}: {', '.join(found)} ({ANSWER:g} s)")
        done = True
        if args.verb == "show":
            view.wait(ANSWER, lambda: len(view.epochs) == len(found))
        else:
            done = _order(view, args)
        write_lines(view.table())
    return 0 if done and len({epoch.frames for epoch in view.epochs.values()}) == 1 else 1


class EpochView:
    """What the hosts of an app tell of its members."""

    def __init__(self, found: Mapping[str, Bus], app: str) -> None:
        self.epochs: dict[str, AppEpoch] = {}
        self.app = app
        self.buses = found
        self._changed = threading.Condition()

    def wait(self, seconds: float, enough: Callable[[], bool], order: Callable[[], None] = lambda: None) -> bool:
        """Order and ask again and again until there is enough, or the time is over."""
        end = clock.now() + seconds
        while not enough() and clock.now() < end:
            order()
            for name, bus in self.buses.items():
                bus.ask(key(name, f"app/{self.app}", "epoch"), partial(self._take, name))
            with self._changed:
                self._changed.wait_for(enough, ROUND)  # an answer is no reason to ask at once
        return enough()

    def table(self) -> list[str]:
        """What people read."""
        lines = []
        for name in self.buses:
            epoch = self.epochs.get(name)
            if epoch is None:
                lines.append(f"{name}  silent")
                continue
            marks = [f"sent away: {' '.join(epoch.away)}"] if epoch.away else []
            marks += ["without a majority"] if epoch.forced else []
            more = f"  ({'; '.join(marks)})" if marks else ""
            lines.append(f"{name}  epoch {epoch.epoch} from iteration {epoch.k} on: {' '.join(epoch.members)}{more}")
        return lines

    def _take(self, name: str, text: str, payload: bytes) -> None:
        with contextlib.suppress(PayloadError):
            epoch = decode(AppEpoch, payload, text)
            with self._changed:
                self.epochs[name] = epoch
                self._changed.notify_all()


def _order(view: EpochView, args: argparse.Namespace) -> bool:
    """Give the order to one robot; whether its app has followed in time."""
    robots = tuple(getattr(args, "robots", ()))
    members = {name for epoch in view.epochs.values() for name in epoch.members}
    name = next((name for name in view.epochs if name in members and name not in robots), None)
    if name is None:
        raise LocalError(f"none of {', '.join(view.epochs)} is in {args.app}: ask a robot that is")
    before = view.epochs[name]
    drop = robots if args.verb == "drop" else ()
    add = robots if args.verb == "add" else ()
    wish = SetAppEpoch(f"{os.getpid()}-{os.urandom(4).hex()}", drop, add, args.force)

    def done() -> bool:
        now = view.epochs[name]
        return now.epoch > before.epoch and not set(drop) & set(now.members) and not set(add) & set(now.away)

    def order() -> None:
        view.buses[name].publish(key(name, f"app/{args.app}", "set", "epoch"), wish, urgent=True)

    if not view.wait(args.timeout, done, order):
        most = f"more than half of its {len(before.members)} members must agree"
        print(f"{name} has not followed within {args.timeout:g} s: {most}")
        return False
    view.wait(ANSWER, lambda: len({view.epochs[n].frames for n in view.epochs if n in view.epochs[name].members}) == 1)
    return True
