"""`swarm balance stand|rest|lie|zero`: give robots a mode, and say of each what came of it.

Told are the robots whose buses can be reached: those of a simulation that runs here, else this robot itself. A robot
confirms by its `balancer/state`; a refusal comes with its reason and with the command that gets out of it.
"""

import argparse
import contextlib
import threading
from collections.abc import Mapping
from functools import partial
from pathlib import Path

from swarm import clock
from swarm.bus.zenoh_bus import Bus
from swarm.errors import PayloadError
from swarm.messages import SetMode, read
from swarm.messages.keys import key
from swarm.onboard.body.mode_change import COMMANDS, ModeChange
from swarm.onboard.buses import buses
from swarm.onboard.buses.ask import PATIENCE, opened
from swarm.process.arguments import add_json, number, show
from swarm.process.terminal import columns

TIMEOUT_S = 40.0
"""Seconds for each robot: standing up takes up to 10 s of looking and three tries."""
_ROUND = 0.1
_TOPICS = ("state", "fault", "notice")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare options. Which mode is meant is part of the command's name."""
    parser.add_argument("mode", choices=tuple(COMMANDS), help=argparse.SUPPRESS)
    text = f"seconds to wait for each robot ({TIMEOUT_S:g})"
    parser.add_argument("--timeout", type=number(0.1, 600, "s"), default=TIMEOUT_S, metavar="S", help=text)
    add_json(parser)
    buses.add_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Give the mode over the buses that can be reached; code 1 where a robot refuses or does not answer."""
    outcomes = give(buses.directories_of(args), args.mode, args.timeout)
    robots = {
        name: {"ok": change.outcome.ok, "text": change.outcome.text}
        for name, change in outcomes.items()
        if change.outcome is not None
    }
    rows = [(name, "ok" if row["ok"] else "REFUSED", str(row["text"])) for name, row in robots.items()]
    show(args, {"mode": args.mode, "robots": robots}, columns(rows))
    return 0 if all(row["ok"] for row in robots.values()) else 1


def give(directories: Mapping[str, Path], mode: str, timeout: float) -> dict[str, ModeChange]:
    """Give the mode to the robots with these runtime directories; all of them have an outcome afterwards."""
    changes = {name: ModeChange(mode) for name in directories}
    news = threading.Condition()

    def take(robot: str, text: str, payload: bytes) -> None:
        with contextlib.suppress(PayloadError), news:
            changes[robot].receive(read(text, payload))
            news.notify_all()

    with opened(directories) as there:
        for robot, bus in there.items():
            bus.subscribe([key(robot, "balancer", topic) for topic in _TOPICS], partial(take, robot))
        begin = clock.now()
        while (now := clock.now()) < begin + timeout and _pending(changes):
            for robot, bus in there.items():
                _command(bus, robot, mode, changes[robot], news, now)
            with news:
                news.wait_for(lambda: not _pending(changes), _ROUND)
                if clock.now() > begin + PATIENCE:
                    for change in changes.values():
                        change.silent()
    with news:
        for change in changes.values():
            change.give_up(timeout)
    return changes


def _pending(changes: Mapping[str, ModeChange]) -> bool:
    return any(change.outcome is None for change in changes.values())


def _command(bus: Bus, robot: str, mode: str, change: ModeChange, lock: threading.Condition, now: float) -> None:
    with lock:
        due = change.due(now)
    if due:
        bus.publish(key(robot, "balancer", "set", "mode"), SetMode(COMMANDS[mode]), urgent=True)
