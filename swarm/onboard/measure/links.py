"""`swarm measure rtt|throughput ROBOT [ROBOT]`: links and paths by payload size, as in section 3.6 of the thesis
(figure 3.19): round trip and goodput, for each overlay.

`rtt` sends one message at a time and waits for its answer. `throughput` measures what is carried when messages follow
each other. A link is measured by the `neighbours` overlay, a longer path by `unicast`; `--overlay all` compares all of
them.
"""

import argparse
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path

from swarm import clock
from swarm.bus.zenoh_bus import Bus
from swarm.errors import LocalError
from swarm.messages import GraphRobot
from swarm.messages.keys import is_name
from swarm.onboard.buses import buses
from swarm.onboard.buses.ask import PATIENCE, Views, opened
from swarm.onboard.measure.figures import FLOOD, NEIGHBOURS, OVERLAYS, UNICAST, Figures, Series
from swarm.onboard.measure.senders import Floods, Pings, Sender, UnicastMessages
from swarm.onboard.mesh.collected import CollectedMesh
from swarm.process import arguments

SIZES = (50, 200, 500, 750, 1000)
"""Bytes; those of the thesis' figure 3.19."""

ALL = "all"

SAY_EVERY_S = 5.0
"""Seconds between two words of how far a measurement is."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare `rtt|throughput ROBOT [ROBOT]`, then options. What is measured is part of the command's name."""
    parser.add_argument("what", choices=("rtt", "throughput"), help=argparse.SUPPRESS)
    add_ends(parser)
    parser.add_argument(
        "--overlay",
        choices=(*OVERLAYS, ALL),
        help="default: neighbours for a link, unicast for a path; all compares them",
    )
    # How long a message may be is the mesh's matter: it refuses, and says why.
    parser.add_argument(
        "--sizes", type=arguments.sizes(), default=SIZES, metavar="N,N,...", help="payload sizes in bytes (50,...,1000)"
    )
    parser.add_argument(
        "--count", type=arguments.whole(1, 10_000), default=20, metavar="N", help="messages of each size (20)"
    )
    parser.add_argument(
        "--priority",
        choices=("sync", "bulk"),
        help="class of the messages (default: sync for rtt, bulk for throughput)",
    )


def add_ends(parser: argparse.ArgumentParser) -> None:
    """Declare the ends of the path that is measured, and how the result is told."""
    parser.add_argument(
        "ends", nargs="+", metavar="ROBOT", help="r0 r3: from r0 to r3; on a robot r3 alone means from this robot to r3"
    )
    arguments.add_json(parser)
    buses.add_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Measure and print; code 1 where something was not answered at all."""
    return code(measured(args)[1])


def code(series: Sequence[Series]) -> int:
    """Return the exit code of a measurement."""
    return 1 if any(not row.samples for each in series for row in each.figures) else 0


def measured(args: argparse.Namespace) -> tuple[str, list[Series]]:
    """Measure and print; returns from which robot, and the figures."""
    robot, peer, directory = ends(args)
    with opened({robot: directory}) as found:
        series = _measure(found[robot], robot, peer, args)
    data = {"robot": robot, "what": args.what, "series": [asdict(each) for each in series]}
    arguments.show(args, data, table(robot, args.what, series))
    return robot, series


def ends(args: argparse.Namespace) -> tuple[str, str, Path]:
    """Return from which robot to which, and the first one's runtime directory; raises `LocalError`."""
    named: list[str] = args.ends
    if len(named) == 1 and args.robots is None:
        first, dash, second = named[0].partition("-")
        # A name may have a dash: then the long form helps.
        named = [first, second] if dash and is_name(first) else named
    peer = named[-1]
    if len(named) == 2:
        if args.robots not in (None, named[:1]):
            raise LocalError(f"--robots {','.join(args.robots)} is not {named[0]}, where it is to begin")
        args.robots = named[:1]
    directories = buses.directories_of(args)
    if len(directories) != 1 or len(named) > 2:
        other = next((each for each in directories if each != peer), "r1")
        raise LocalError(f"from which robot to which? write for example {other} {peer}")
    ((robot, directory),) = directories.items()
    if not is_name(peer) or peer == robot:
        raise LocalError(f"{' '.join(named)}: expected two robots like r0 r1")
    return robot, peer, directory


def _measure(bus: Bus, robot: str, peer: str, args: argparse.Namespace) -> list[Series]:
    series = []
    for sender, overlay, to, hops in _ways(bus, robot, peer, args.overlay, args.priority):
        look = partial(_look, bus, robot, f"{overlay} to {to}", _Pace())
        if args.what == "rtt":
            figures = sender.rtt(args.sizes, args.count, look)
        else:
            figures = sender.throughput(args.sizes, max(1, args.count // 10), look)
        series.append(Series(overlay, to, hops, figures))
    return series


class _Pace:
    """The time of the last progress line, so that a short measurement prints only its figures."""

    def __init__(self) -> None:
        self.said_at = clock.now()


def _look(bus: Bus, robot: str, way: str, pace: _Pace, done: int, total: int) -> None:
    """Say how far a measurement is, each `SAY_EVERY_S`; raise `LocalError` where the robot's bus is gone."""
    if not bus.connected:
        raise LocalError(f"the bus of {robot} is gone after {done} of {total} messages: has its simulation ended?")
    if clock.now() >= pace.said_at + SAY_EVERY_S:
        pace.said_at = clock.now()
        sys.stderr.write(f"{robot}: {way}: {done} of {total}\n")


def _ways(
    bus: Bus, robot: str, peer: str, overlay: str | None, priority: str | None
) -> list[tuple[Sender, str, str, int]]:
    """Return what is to be measured: sender, overlay, receiver, number of links."""
    known = _known(bus, robot)
    way = path(known, robot, peer)
    others = [each for each in known.values() if each.hops]
    ways: list[tuple[Sender, str, str, int]] = []
    if overlay in (ALL, NEIGHBOURS) or (overlay is None and len(way) == 1):
        # Of a longer path the first link, to compare; asked for by itself, the mesh says that it is none.
        to = way[0] if overlay == ALL else peer
        ways.append((Pings(bus, robot, to, priority), NEIGHBOURS, to, 1))
    if overlay == ALL:
        ways += [(UnicastMessages(bus, robot, to, priority), UNICAST, to, hops) for hops, to in enumerate(way, 1)]
    elif overlay == UNICAST or (overlay is None and len(way) > 1):
        ways.append((UnicastMessages(bus, robot, peer, priority), UNICAST, peer, len(way)))
    if overlay in (ALL, FLOOD):
        farthest = max(each.hops or 0 for each in others)
        ways.append((Floods(bus, robot, priority), FLOOD, f"{len(others)} robots", farthest))
    return ways


def _known(bus: Bus, robot: str) -> Mapping[str, GraphRobot]:
    views = Views()
    views.ask(robot, bus, PATIENCE)
    with views.changed:
        if not views.changed.wait_for(lambda: robot in views.robots, PATIENCE):
            raise LocalError(f"the mesh of {robot} does not answer ({PATIENCE:g} s)")
    return views.best()


def path(known: Mapping[str, GraphRobot], robot: str, peer: str) -> list[str]:
    """Return the robots from a neighbour of `robot` to `peer`: a shortest way, the one that unicast takes or one as
    long; `LocalError` where there is none."""
    end = known.get(peer)
    if end is None:
        raise LocalError(f"there is no robot {peer}, there are {' '.join(name for name in known if name != robot)}")
    if not end.hops:
        what = {"never": "it was never seen", "left": "it has left"}.get(end.state, f"it is {end.state}")
        raise LocalError(f"there is no way from {robot} to {peer}: {what}")
    graph = CollectedMesh({}, known).graph
    if end.via is None or robot not in (distances := graph.distances(peer)):
        raise LocalError(f"the way from {robot} to {peer} has just changed, try again")
    way = [end.via]
    while way[-1] != peer:
        way.append(min(graph.neighbours(way[-1]), key=lambda name: (distances.get(name, len(known)), name)))
    return way


def table(robot: str, what: str, series: Sequence[Series]) -> list[str]:
    """Return the lines of a table, a part for each way of sending."""
    lines: list[str] = []
    for each in series:
        if what == "throughput":
            lines += [f"{robot}: {each.label}: messages that follow each other", " bytes  bursts  lost    payload B/s"]
            lines += [f"{row.size:>6}{row.samples:>8}{row.lost:>6}{_rate(row):>15}" for row in each.figures]
        else:
            there, rate = ("payload there and back", "2s/RTT") if each.overlay == NEIGHBOURS else ("confirmed", "s/RTT")
            lines += [
                f"{robot}: {each.label}: one message at a time, {there}",
                f" bytes     n  lost  min ms  median    mean      sd     p99{rate:>9} B/s",
            ]
            for row in each.figures:
                times = (row.rtt_min, row.rtt_median, row.rtt_mean, row.rtt_deviation, row.rtt_p99)
                cells = "".join(f"{'-' if time is None else f'{time * 1e3:.1f}':>8}" for time in times)
                lines.append(f"{row.size:>6}{row.samples:>6}{row.lost:>6}{cells}{_rate(row):>13}")
        lines.append("")
    return lines[:-1]


def _rate(row: Figures) -> str:
    if row.goodput is None:
        return "in one go" if row.samples else "-"
    return f"{row.goodput:.0f}"
