"""`swarm estop [REASON]` and `swarm arm`: stop every robot, or take every stop back, and say who has confirmed it.

The command goes to every bus that can be reached, so that these robots obey even where their meshes are dead; the mesh
carries it to the others. It is given again until it is confirmed, since a bus may lose it. A robot confirms by its
`mesh/stopped`, its own or what it floods; where its balancer's state can be seen, the motors must be off, too. Nothing
moves by `swarm arm`: balancers wait for a command.
"""

import argparse
import contextlib
import os
import subprocess
import sys
from collections.abc import Collection, Container, Mapping, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import NoReturn

from swarm import clock
from swarm.bus.zenoh_bus import Bus
from swarm.errors import LocalError, PayloadError, SwarmError
from swarm.frozen import frozen
from swarm.messages import Arm, BalancerState, GraphRobot, Stop, read
from swarm.messages.keys import STOP, key, parse
from swarm.onboard.buses import buses
from swarm.onboard.buses.ask import AWAY, Views, opened
from swarm.process.arguments import add_json, number, show
from swarm.process.paths import DEFAULT_RUNTIME, GYRO_ZERO
from swarm.process.terminal import columns

ROUND = 0.2
"""Seconds between two looks; the command is repeated where it is not confirmed by then."""

ANSWER = 2.0
"""Seconds that a mesh has for its answer; questions overlap."""

MOVING = ("standing_up", "balancing", "lying_down", "testing")
"""Modes of a balancer whose motors are on."""

LISTENING_S = 0.5
"""Seconds after which a balancer that was not heard on a bus that can be reached is taken for absent: one that runs
tells its state every 0.04 s."""

_END = ("sudo", "-n", "systemctl", "stop", "swarm-balancer.service")
_END_S = 15.0
"""Seconds that systemd has for it."""

LOOP_S = 3.0
"""Seconds since a balancing loop last wrote its gyro's zero after which it does not run any more."""

DEFAULT_REASON = "swarm estop"

NOBODY = "NO ROBOT WAS STOPPED OR ARMED"
"""Part of each error by which nothing was done: whoever has mistyped in an emergency must see it at once."""

NEXT = "nothing moves by that; to make robots stand: swarm balance stand"
"""Said after `swarm arm`."""


@frozen
class Row:
    """The state of one robot in the table of a stop."""

    robot: str
    state: str
    """here, silent (its bus is there, its mesh does not answer), left, gone, never or no bus."""
    stopped: bool | None
    """Whether the robot itself reports that it is stopped; None: it has reported nothing."""
    mode: str | None
    """Mode of its balancer, if it can be seen."""
    confirmed: bool


class _Words(argparse.Action):
    """Takes the words of a reason as one text: whoever forgets the quotes in a hurry stops the robots, too."""

    def __call__(self, _: object, namespace: argparse.Namespace, values: object, *__: object) -> None:
        setattr(namespace, self.dest, " ".join(values) if isinstance(values, list) else values)


def add_arguments(parser: argparse.ArgumentParser) -> list[argparse.ArgumentParser]:
    """Declare `stop [REASON]` and `arm` with their options, and return the parsers of the two.

    Which of them is meant is part of the command's name.
    """
    acts = parser.add_subparsers(dest="act", required=True, prog=parser.prog)
    parsers = [acts.add_parser(name, prog=parser.prog, description=parser.description) for name in ("stop", "arm")]
    text = "why the robots stop; their logs and faults show it (swarm estop)"
    parsers[0].add_argument("reason", nargs="*", metavar="REASON", default=DEFAULT_REASON, action=_Words, help=text)
    parsers[0].set_defaults(since=None)
    parsers[1].set_defaults(reason="")
    # The laptop tells when the command was given, in seconds of this robot's clock.
    parsers[1].add_argument("--since", type=float, help=argparse.SUPPRESS)
    for each in parsers:
        text = "seconds to wait for all robots to confirm (5)"
        each.add_argument("--timeout", type=number(0.1, 600, "s"), default=5.0, metavar="S", help=text)
        add_json(each)
        buses.add_arguments(each)
    for each in (parser, *parsers):
        each.error = partial(_refuse, each)  # type: ignore[method-assign]
    return parsers


def _refuse(parser: argparse.ArgumentParser, message: str) -> NoReturn:
    """End with a message that says what did not happen."""
    parser.print_usage(sys.stderr)
    parser.exit(2, f"swarm: {message}; {NOBODY}: swarm estop, without more, stops all\n")


def run(args: argparse.Namespace) -> int:
    """Stop or arm over the buses that can be reached; code 1 where a robot has not confirmed in time or has an unknown
    name."""
    try:
        there = buses.all_directories(args.run_dir)
        unknown = take_unknown(args, there)
        rows = stop_or_arm(
            {name: place for name, place in there.items() if not args.robots or name in args.robots},
            stop=args.act == "stop",
            reason=args.reason,
            timeout=args.timeout,
            since=args.since,
        )
    except SwarmError as error:  # no bus, or no configuration that says who this is
        if args.act != "stop" or not _is_robots_own(args):
            raise nobody(error) from None
        raise LocalError(f"{error}; {_end_balancer()}") from None
    done = all_confirmed([row.confirmed for row in reached(rows)])
    show(args, report(args, rows, unknown, done=done), table(rows, stop=args.act == "stop"))
    return ended(unknown, done=done)


def nobody(error: SwarmError) -> LocalError:
    """Return an error that says that nothing was done."""
    return LocalError(f"{error}; {NOBODY}")


def take_unknown(args: argparse.Namespace, there: Collection[str]) -> list[str]:
    """Take the names that are not in `there` out of `args.robots`, and return them: a stop reaches the other robots all
    the same. Raises `LocalError` where no robot is left, and for any such name of `swarm arm`."""
    unknown = [name for name in args.robots or () if name not in there]
    if unknown and (args.act != "stop" or len(unknown) == len(args.robots)):
        raise LocalError(f"there is no robot {', '.join(unknown)}, but {', '.join(there)}")
    args.robots = [name for name in args.robots or () if name in there] or None
    return unknown


def ended(unknown: Sequence[str], *, done: bool) -> int:
    """Return the exit code, and name the robots that nobody knows where everyone sees it."""
    if unknown:
        sys.stdout.flush()
        sys.stderr.write(f"swarm: there is no robot {', '.join(unknown)}: NOBODY WAS STOPPED BY THAT NAME\n")
    return 0 if done and not unknown else 1


def reached(rows: list[Row]) -> list[Row]:
    """Return the robots that could be told."""
    return [row for row in rows if row.state not in (*AWAY, "no bus")]


def all_confirmed(confirmed: Collection[bool]) -> bool:
    """Return whether all robots have confirmed. It is False for no robots: nobody may take that for a stop."""
    return bool(confirmed) and all(confirmed)


def report(args: argparse.Namespace, rows: list[Row], unknown: Sequence[str], *, done: bool) -> dict[str, object]:
    """Return what programs read."""
    found: dict[str, object] = {"stop": args.act == "stop", "confirmed": done and not unknown}
    return found | {"robots": [asdict(row) for row in rows], "unknown": list(unknown)}


def stop_over_buses(run_dir: Path | None, reason: str) -> list[Row]:
    """Stop all robots over their buses, as `swarm estop` does; see `stop_or_arm`. Raises `LocalError`."""
    return stop_or_arm(buses.all_directories(run_dir), stop=True, reason=reason)


def stop_or_arm(
    directories: Mapping[str, Path], *, stop: bool, reason: str, timeout: float = 5.0, since: float | None = None
) -> list[Row]:
    """Stop or arm over the buses with these runtime directories; returns what each robot has confirmed within `timeout`
    s. `since`: the time at which the command was given, s, where it was before now."""
    given = clock.now() if since is None else min(since, clock.now())
    views, modes = Views(), dict[str, str]()

    def take(text: str, payload: bytes) -> None:
        with contextlib.suppress(PayloadError):
            message = read(text, payload)
            if isinstance(message, BalancerState):
                with views.changed:
                    modes[parse(text).robot] = message.mode
                    views.changed.notify_all()

    def look() -> list[Row]:
        there = {name: bus.connected for name, bus in found.items()}
        running = {name for name in found if loop_runs(directories[name])}
        listened = clock.now() > began + LISTENING_S
        with views.changed:
            seen = dict(modes)
        return rows_of(there, views.best(), seen, stop=stop, listened=listened, running=running)

    with opened(directories) as found:
        for bus in found.values():
            bus.subscribe(key("*", "balancer", "state"), take)
        began = clock.now()
        rows: list[Row] = []
        while True:
            confirmed = {row.robot for row in rows if row.confirmed}
            for name, bus in found.items():
                if name not in confirmed:
                    _give(name, bus, stop=stop, reason=reason, age=clock.now() - given)
                views.ask(name, bus, ANSWER)
            round_end = min(began + timeout, clock.now() + ROUND)
            while clock.now() < round_end:
                with views.changed:
                    views.changed.wait(max(0.0, round_end - clock.now()))
                rows = look()
                if all(_is_final(row, found) for row in rows):
                    return rows
            if clock.now() >= began + timeout:
                return rows


def rows_of(
    names: Mapping[str, bool],
    known: Mapping[str, GraphRobot],
    modes: Mapping[str, str],
    *,
    stop: bool,
    listened: bool,
    running: Container[str],
) -> list[Row]:
    """Return one row for each robot. `names`: the robots whose bus was looked for, and whether it is there. `listened`:
    whether a balancer on such a bus would have been heard by now. `running`: robots whose balancing loop is known to
    run, though its state may not be heard."""
    rows = []
    for name in sorted({*names, *known}):
        entry, mode = known.get(name), modes.get(name)
        absent = (listened or not names.get(name)) and name not in running
        still = mode not in MOVING and (mode is not None or absent)
        if entry is not None and entry.state not in AWAY:
            # Who has said nothing since it was started has heard of no stop.
            confirmed = (entry.stopped is True and still) if stop else not entry.stopped
            rows.append(Row(name, "here", entry.stopped, mode, confirmed))
        elif names.get(name):
            # A balancer obeys its bus without a mesh; only, nobody will repeat the stop.
            rows.append(Row(name, "silent", None, mode, stop and mode is not None and still))
        else:
            rows.append(Row(name, entry.state if entry is not None else "no bus", None, mode, False))
    return rows


def table(rows: list[Row], *, stop: bool) -> list[str]:
    """Return the table as lines for people."""
    lines = [("robot", "state", "stopped", "balancer", "")]
    for row in rows:
        stopped = {True: "yes", False: "no", None: "-"}[row.stopped]
        lines.append((row.robot, row.state, stopped, row.mode or "-", _remark(row, stop=stop)))
    missing = [row.robot for row in rows if not row.confirmed and row.state in ("here", "silent")]
    away = [row.robot for row in rows if row.state not in ("here", "silent")]
    what = "stopped" if stop else "armed"
    confirmed = sum(row.confirmed for row in rows)
    summary = f"{what}: {confirmed} of {len(rows)} robots"
    if missing:
        summary += f"; not confirmed: {' '.join(missing)}"
    if away:
        summary += f"; out of reach: {' '.join(away)} (told when they are back)"
    return [*columns(lines), "", summary, *([] if stop else [NEXT])]


def _remark(row: Row, *, stop: bool) -> str:
    if row.confirmed:
        return "its mesh does not answer: nobody repeats the stop" if row.state == "silent" else ""
    if row.state == "silent":
        return "its mesh does not answer"
    if row.state == "no bus":
        return "nobody knows where it is"
    if row.state != "here":
        return "out of reach"
    if stop and row.stopped:
        return "its motors are on" if row.mode else "its balancer tells no state: sudo systemctl stop swarm-balancer"
    return "not confirmed"


def _is_robots_own(args: argparse.Namespace) -> bool:
    """Return whether this is a robot, and its own bus is meant."""
    runtime = os.environ.get("SWARM_RUNTIME", str(DEFAULT_RUNTIME))
    return not (args.run_dir or args.robots) and runtime == str(DEFAULT_RUNTIME) and DEFAULT_RUNTIME.is_dir()


def _end_balancer() -> str:
    """Have systemd stop this robot's balancer, where its bus takes no stop; return what came of it."""
    try:
        done = subprocess.run(_END, check=False, capture_output=True, timeout=_END_S).returncode == 0
    except (OSError, subprocess.TimeoutExpired):
        done = False
    if done:
        return "this robot's balancer was stopped by systemd, and no other robot was told"
    return "no robot was stopped: sudo systemctl stop swarm-balancer"


def loop_runs(directory: Path) -> bool:
    """Return whether a balancing loop runs with this runtime directory: it writes its gyro's zero once a second."""
    try:
        used = float((directory / GYRO_ZERO).read_text().split()[-1])
    except (OSError, ValueError, LookupError):
        return False
    return 0.0 <= clock.now() - used <= LOOP_S


def _is_final(row: Row, opened_buses: Mapping[str, Bus]) -> bool:
    """Return whether waiting changes nothing. Whose own bus is asked may only not have answered yet, whatever others
    say."""
    return (row.confirmed and row.state == "here") or (row.state in AWAY and row.robot not in opened_buses)


def _give(name: str, bus: Bus, *, stop: bool, reason: str, age: float) -> None:
    if stop:
        bus.publish(STOP, Stop(clock.now(), name, reason))
    else:
        bus.publish(key(name, "mesh", "set", "arm"), Arm(clock.now(), "swarm arm", age), urgent=True)
