"""What `swarm estop` and `swarm arm` have in common: give the command, then wait until every robot confirms it.

The command goes to every bus that can be reached, so that these robots obey even where their meshes are dead; the mesh
carries it to the others. It is given again until it is confirmed, since a bus may lose it. A robot confirms by its
`mesh/stopped`, its own or what it floods; where its balancer's state can be seen, the motors must be off, too.

From a laptop each robot is told by ssh, too, at the same time (halt_ssh.py): it is confirmed by any of these.
"""

import argparse
import contextlib
import json
import threading
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path

from laptop.cli.mesh.survey import AWAY, MeshViews, opened
from laptop.cli.stop import halt_ssh
from swarm import clock
from swarm.bus.zenoh_bus import Bus
from swarm.errors import LocalError, PayloadError
from swarm.frozen import frozen
from swarm.messages import Arm, BalancerState, GraphRobot, Stop, read
from swarm.messages.keys import STOP, key, parse
from swarm.onboard import buses
from swarm.process.terminal import write_lines

ROUND = 0.2
"""s between two looks; the command is repeated where it is not confirmed by then."""

ANSWER = 2.0
"""s that a mesh has for its answer; questions overlap."""

MOVING = ("standing_up", "balancing")
"""Modes of a balancer whose motors are on."""


@frozen
class HaltRow:
    """One robot."""

    robot: str
    state: str
    """here, silent (its bus is there, its mesh does not answer), left, gone, never or no bus."""
    stopped: bool | None
    """By its own word; None = it has said nothing."""
    mode: str | None
    """Of its balancer, where that can be seen."""
    confirmed: bool


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """What both verbs take."""
    parser.add_argument("--timeout", type=_seconds, default=5.0, metavar="S", help="seconds to wait (5)")
    parser.add_argument("--json", action="store_true", help="one JSON object")
    parser.add_argument("--no-ssh", action="store_true", help="over bus and mesh only")
    parser.add_argument("--config", type=Path, metavar="FILE", help="the robots to reach by ssh")
    parser.add_argument("--ssh-config", type=Path, metavar="FILE", help="in place of ~/.ssh/config")
    buses.add_arguments(parser)


def run(args: argparse.Namespace, *, stop: bool, reason: str) -> int:
    """Stop or arm over every path there is; `LocalError` where there is none."""
    far = halt_ssh.robots_of(args)
    try:
        found = buses.find(args)
    except LocalError:
        if far is None:
            raise
        found = {}
    answers = halt_ssh.Answers()
    thread = None
    if far is not None:
        reachable, ssh = far

        def by_ssh() -> None:
            nonlocal answers
            answers = halt_ssh.command(reachable, ssh, stop=stop, reason=reason)

        thread = threading.Thread(target=by_ssh, name="ssh")
        thread.start()
    rows: list[HaltRow] = []
    if found:
        with opened(found) as opened_buses:
            rows = _command(opened_buses, stop=stop, reason=reason, timeout=args.timeout)
    if thread is not None:
        thread.join()
    by_robot = {row.robot: row for row in rows}
    reached = [row for row in rows if row.state not in (*AWAY, "no bus") and row.robot not in answers.outcomes]
    done = all(row.confirmed for row in reached) and all(_how(name, by_robot, answers) for name in answers.outcomes)
    if args.json:
        report: dict[str, object] = {"stop": stop, "confirmed": done, "robots": [asdict(row) for row in rows]}
        if far is not None:
            report["ssh"] = {
                name: {"confirmed": outcome.ok, "text": outcome.text} for name, outcome in answers.outcomes.items()
            }
        print(json.dumps(report))
    else:
        if rows:
            write_lines(table(rows, stop=stop))
        if far is not None:
            write_lines(ssh_table(by_robot, answers, stop=stop))
    return 0 if done else 1


def _how(name: str, rows: Mapping[str, HaltRow], answers: halt_ssh.Answers) -> str:
    """By which path a robot is confirmed; empty where by none."""
    paths = []
    if name in rows and rows[name].confirmed:
        paths.append("bus or mesh")
    if name in answers.outcomes and answers.outcomes[name].ok:
        paths.append("ssh")
    if name in answers.seen:
        paths.append(f"mesh (seen by {answers.seen[name]})")
    return ", ".join(paths)


def ssh_table(rows: Mapping[str, HaltRow], answers: halt_ssh.Answers, *, stop: bool) -> list[str]:
    """What people read of the robots that ssh was to reach."""
    what = "stopped" if stop else "armed"
    lines = [("robot", what, "confirmed by", "ssh says")]
    for name, outcome in answers.outcomes.items():
        how = _how(name, rows, answers)
        lines.append((name, "yes" if how else "NOT CONFIRMED", how or "-", outcome.text))
    widths = [max(len(line[column]) for line in lines) for column in range(3)]
    text = ["  ".join([*(cell.ljust(n) for cell, n in zip(line, widths, strict=False)), line[3]]) for line in lines]
    missing = [name for name in answers.outcomes if not _how(name, rows, answers)]
    summary = f"{what}: {len(answers.outcomes) - len(missing)} of {len(answers.outcomes)} robots"
    return [*text, "", summary + (f"; NOT CONFIRMED: {' '.join(missing)}" if missing else "")]


def rows_of(
    names: Mapping[str, bool], known: Mapping[str, GraphRobot], modes: Mapping[str, str], *, stop: bool
) -> list[HaltRow]:
    """One row a robot. `names`: robots whose bus was looked for, and whether it is there."""
    rows = []
    for name in sorted({*names, *known}):
        entry, mode = known.get(name), modes.get(name)
        still = mode is None or mode not in MOVING
        if entry is not None and entry.state not in AWAY:
            # Who has said nothing since it was started has heard of no stop.
            confirmed = (entry.stopped is True and still) if stop else not entry.stopped
            rows.append(HaltRow(name, "here", entry.stopped, mode, confirmed))
        elif names.get(name):
            # A balancer obeys its bus without a mesh; only, nobody will repeat the stop.
            rows.append(HaltRow(name, "silent", None, mode, stop and mode is not None and still))
        else:
            rows.append(HaltRow(name, entry.state if entry is not None else "no bus", None, mode, False))
    return rows


def table(rows: list[HaltRow], *, stop: bool) -> list[str]:
    """What people read."""
    lines = [("robot", "state", "stopped", "balancer", "")]
    for row in rows:
        stopped = {True: "yes", False: "no", None: "-"}[row.stopped]
        lines.append((row.robot, row.state, stopped, row.mode or "-", _remark(row, stop=stop)))
    widths = [max(len(line[column]) for line in lines) for column in range(4)]
    text = ["  ".join([*(cell.ljust(n) for cell, n in zip(line, widths, strict=False)), line[4]]) for line in lines]
    missing = [row.robot for row in rows if not row.confirmed and row.state in ("here", "silent")]
    away = [row.robot for row in rows if row.state not in ("here", "silent")]
    what = "stopped" if stop else "armed"
    confirmed = sum(row.confirmed for row in rows)
    summary = f"{what}: {confirmed} of {len(rows)} robots"
    if missing:
        summary += f"; not confirmed: {' '.join(missing)}"
    if away:
        summary += f"; out of reach: {' '.join(away)} (told when they are back)"
    return [line.rstrip() for line in text] + ["", summary]


def _remark(row: HaltRow, *, stop: bool) -> str:
    if row.confirmed:
        return "its mesh does not answer: nobody repeats the stop" if row.state == "silent" else ""
    if row.state == "silent":
        return "its mesh does not answer"
    if row.state == "no bus":
        return "nobody knows where it is"
    if row.state != "here":
        return "out of reach"
    if stop and row.stopped:
        return "its motors are on"
    return "not confirmed"


def _command(opened_buses: Mapping[str, Bus], *, stop: bool, reason: str, timeout: float) -> list[HaltRow]:
    views, modes = MeshViews(), dict[str, str]()

    def take(text: str, payload: bytes) -> None:
        with contextlib.suppress(PayloadError):
            message = read(text, payload)
            if isinstance(message, BalancerState):
                with views.changed:
                    modes[parse(text).robot] = message.mode
                    views.changed.notify_all()

    for bus in opened_buses.values():
        bus.subscribe(key("*", "balancer", "state"), take)
    end = clock.now() + timeout
    rows: list[HaltRow] = []
    while True:
        confirmed = {row.robot for row in rows if row.confirmed}
        for name, bus in opened_buses.items():
            if name not in confirmed:
                _give(name, bus, stop=stop, reason=reason)
            views.ask(name, bus, ANSWER)
        round_end = min(end, clock.now() + ROUND)
        while clock.now() < round_end:
            with views.changed:
                views.changed.wait(max(0.0, round_end - clock.now()))
                seen = dict(modes)
            there = {name: bus.connected for name, bus in opened_buses.items()}
            rows = rows_of(there, views.best(), seen, stop=stop)
            if all(_is_final(row, opened_buses) for row in rows):
                return rows
        if clock.now() >= end:
            return rows


def _is_final(row: HaltRow, opened_buses: Mapping[str, Bus]) -> bool:
    """Whether waiting changes nothing. Whose own bus is asked may only not have answered yet, whatever others say."""
    return (row.confirmed and row.state == "here") or (row.state in AWAY and row.robot not in opened_buses)


def _give(name: str, bus: Bus, *, stop: bool, reason: str) -> None:
    if stop:
        bus.publish(STOP, Stop(clock.now(), name, reason))
    else:
        bus.publish(key(name, "mesh", "set", "arm"), Arm(clock.now(), "swarm arm"), urgent=True)


def _seconds(text: str) -> float:
    try:
        seconds = float(text)
    except ValueError:
        seconds = 0.0
    if 0.1 <= seconds <= 600.0:
        return seconds
    raise argparse.ArgumentTypeError(f"{text!r}: expected 0.1 to 600 s")
