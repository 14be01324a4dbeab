"""`swarm mesh topology show|set`: which robots shall be linked, and changing that while the swarm runs.

Any one robot takes the wish; its mesh tells the others. Asked are the meshes whose buses can be reached: all of a
simulation, else this robot's own, which cannot say whether the others have followed already.
"""

import argparse
import contextlib
import json
import os
import threading
from collections.abc import Callable, Mapping
from dataclasses import asdict

from laptop.cli.mesh.survey import opened
from swarm import clock
from swarm.bus.zenoh_bus import Bus
from swarm.core.graph import SHAPES
from swarm.errors import LocalError, PayloadError
from swarm.messages import Topology, TopologyRequest, TopologySet
from swarm.messages.codec import decode
from swarm.messages.keys import is_name, key
from swarm.onboard import buses
from swarm.process.terminal import write_lines

HELP = "show or change who is linked with whom, while the swarm runs"

ROUND = 0.3
"""s between two questions, and until a request without an answer is repeated."""

ANSWER = 3.0
"""s within which a mesh that is there answers."""

AUTO = "auto"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """`show` or `set WANTED...`, then options."""
    verbs = parser.add_subparsers(dest="verb", required=True, metavar="show|set")
    show = verbs.add_parser("show", help="the topology in force on each robot; code 1 where a link is not up")
    change = verbs.add_parser("set", help="another topology for the whole swarm")
    change.add_argument(
        "wanted",
        nargs="+",
        metavar="SHAPE|A-B",
        help=f"{', '.join(SHAPES)}, {AUTO} (robots find their neighbours), or all links: r0-r1 r1-r2 ... (a:b where a "
        "name has a dash)",
    )
    change.add_argument("--after", type=int, metavar="VERSION", help="only if this version is in force")
    change.add_argument("--timeout", type=float, default=20.0, metavar="S", help="seconds to wait for the links (20)")
    for each in (show, change):
        buses.add_arguments(each)
        each.add_argument("--json", action="store_true", help="one JSON object")


def run(args: argparse.Namespace) -> int:
    """Code 1 where a robot is silent, has another version, or lacks a link; a refused wish is a `LocalError`."""
    wish = _wish(args.wanted) if args.verb == "set" else None
    with opened(buses.find(args)) as found:
        views = TopologyViews(found)
        if wish is None:
            views.wait(ANSWER, lambda: len(views.answers) == len(found))
        else:
            version = _set(found, *wish, args.after)
            views.wait(args.timeout, lambda: views.done(version))
        if not views.answers:
            raise LocalError(f"no mesh tells its topology: {', '.join(found)} ({ANSWER:g} s)")
    done = views.done()
    if args.json:
        robots = {name: None if answer is None else asdict(answer) for name, answer in views.robots().items()}
        print(json.dumps({"done": done, "robots": robots}))
    else:
        write_lines(views.table())
    return 0 if done else 1


class TopologyViews:
    """What the meshes tell of the topology."""

    def __init__(self, found: Mapping[str, Bus]) -> None:
        self._buses = found
        self._changed = threading.Condition()
        self.answers: dict[str, Topology] = {}

    def wait(self, seconds: float, enough: Callable[[], bool]) -> None:
        """Ask again and again, until there is enough, or the time is over."""
        end = clock.now() + seconds
        while not enough() and clock.now() < end:
            for name, bus in self._buses.items():
                bus.ask(key(name, "mesh", "topology"), lambda text, data, name=name: self._take(name, text, data))  # type: ignore[misc]
            with self._changed:
                self._changed.wait_for(enough, ROUND)  # an answer is no reason to ask at once

    def robots(self) -> dict[str, Topology | None]:
        """By name; None = silent."""
        with self._changed:
            return {name: self.answers.get(name) for name in self._buses}

    def done(self, version: int = 0) -> bool:
        """Whether all tell one and the same topology, not an earlier one, and its links are up and no others."""
        known = self.robots().values()
        values = {None if each is None else (each.version, each.step, each.issuer, each.edges) for each in known}
        return len(values) == 1 and all(
            each is not None and each.version >= version and each.wanted == each.up and not each.kept for each in known
        )

    def table(self) -> list[str]:
        """What people read."""
        rows: list[tuple[str, ...]] = [
            ("robot", "version", "set on", "links up", "not up", "beyond it", "out of reach")
        ]
        for name, each in self.robots().items():
            if each is None:
                rows.append((name, "silent", "", "", "", "", ""))
                continue
            down = [peer for peer in each.wanted if peer not in each.up]
            missing = [f"{robot} ({why})" for robot, why in sorted(each.missing.items())]
            rows.append(
                (
                    name,
                    _version(each),
                    each.issuer or "-",
                    " ".join(each.up) or "-",
                    " ".join(down) or "-",
                    " ".join(each.kept) or "-",
                    ", ".join(missing) or "-",
                )
            )
        widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
        lines = ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]
        newest = max(self.answers.values(), key=lambda each: (each.version, each.step, each.issuer))
        links = " ".join(f"{a}-{b}" if "-" not in a + b else f"{a}:{b}" for a, b in newest.edges) or "none yet"
        return [*lines, "", f"version {_version(newest)}{', automatic' if newest.auto else ''}: {links}"]

    def _take(self, name: str, text: str, payload: bytes) -> None:
        with contextlib.suppress(PayloadError):
            answer = decode(Topology, payload, text)
            with self._changed:
                self.answers[name] = answer
                self._changed.notify_all()


def _version(topology: Topology) -> str:
    return f"{topology.version}.{topology.step}" if topology.auto else str(topology.version)


def _wish(words: list[str]) -> tuple[str, tuple[tuple[str, ...], ...]]:
    """A shape, or links."""
    if len(words) == 1 and is_name(words[0].partition(":")[0]) and _pair(words[0]) is None:
        return words[0], ()
    edges = []
    for word in ",".join(words).split(","):
        pair = _pair(word)
        if pair is None:
            raise LocalError(f"{word[:40]!r} is no link: write r0-r1, or r0:r1 where a name has a dash")
        edges.append(pair)
    return "", tuple(edges)


def _pair(word: str) -> tuple[str, str] | None:
    """The two ends of a link."""
    if word in SHAPES or word.startswith("random:"):
        return None
    a, mark, b = word.partition(":" if ":" in word else "-")
    return (a, b) if mark and is_name(a) and is_name(b) and (mark == ":" or "-" not in b) else None


def _set(found: Mapping[str, Bus], shape: str, edges: tuple[tuple[str, ...], ...], after: int | None) -> int:
    """Ask the first robot whose bus is there; the version that is then in force, `LocalError` where it is refused."""
    name, bus = next((name, bus) for name, bus in found.items() if bus.connected)
    request = TopologyRequest(f"{os.getpid()}-{os.urandom(4).hex()}", shape, edges, after)
    answers: list[TopologySet] = []
    answered = threading.Event()

    def take(text: str, payload: bytes) -> None:
        with contextlib.suppress(PayloadError):
            answer = decode(TopologySet, payload, text)
            if answer.ticket == request.ticket:
                answers.append(answer)
                answered.set()

    bus.subscribe(key(name, "mesh", "topology_set"), take)
    end = clock.now() + ANSWER
    while not answers and clock.now() < end:
        bus.publish(key(name, "mesh", "set", "topology"), request, urgent=True)
        answered.wait(ROUND)
    if not answers:
        raise LocalError(f"the mesh of {name} does not answer within {ANSWER:g} s")
    if answers[0].problem:
        raise LocalError(f"{name}: {answers[0].problem}")
    return answers[0].version
