"""`swarm measure rtt|throughput|rssi ROBOT [ROBOT]`: links and paths by payload size, as in section 3.6 of the thesis
(figure 3.19): round trip and goodput, for each overlay.

`rtt` sends one message at a time and waits for its answer. `throughput` measures what is carried when messages follow
each other. A link is measured by the `neighbours` overlay, a longer path by `unicast`; `--overlay all` compares all of
them. `rssi` asks the Bluetooth adapter for the signal of a link. `swarm measure i2c` is a command of its own.
"""

import argparse
import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path

from laptop.cli.measure import show
from laptop.cli.measure.figures import FLOOD, NEIGHBOURS, OVERLAYS, UNICAST, Series
from laptop.cli.measure.senders import Floods, Pings, Sender, UnicastMessages
from laptop.cli.mesh.collected import CollectedMesh
from laptop.cli.mesh.survey import PATIENCE, MeshViews, opened
from swarm.bus.zenoh_bus import Bus
from swarm.errors import LocalError
from swarm.messages import GraphRobot
from swarm.messages.keys import is_name
from swarm.onboard import buses
from swarm.process.terminal import write_lines

HELP = "round trips, throughput, signal of links and paths; i2c: rates of a robot's bus"

SIZES = (50, 200, 500, 750, 1000)
"""Bytes; those of the thesis' figure 3.19."""

ALL = "all"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """`rtt|throughput|rssi ROBOT [ROBOT] [--overlay O] [--sizes ...] [--count N] [--plot FILE]`."""
    parser.add_argument("what", choices=("rtt", "throughput", "rssi"))
    parser.add_argument("ends", nargs="+", metavar="ROBOT", help="r0 r3: from r0 to r3; on a robot also just r3")
    parser.add_argument("--overlay", choices=(*OVERLAYS, ALL), help="neighbours for a link, unicast for a path; all")
    parser.add_argument("--sizes", type=_sizes, default=SIZES, metavar="N,N,...", help="payload bytes (50,...,1000)")
    parser.add_argument("--count", type=_count, default=20, metavar="N", help="messages of each size (20)")
    parser.add_argument("--priority", choices=("sync", "bulk"), help="class of the messages; sync unless they are many")
    parser.add_argument("--plot", type=Path, metavar="FILE", help="draw it: .png, .pdf or .svg")
    parser.add_argument("--json", action="store_true", help="one JSON object")
    buses.add_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Measure and print; code 1 where something was not answered at all."""
    robot, peer, directory = _ends(args)
    if args.what == "rssi":
        from laptop.cli.measure import rssi

        return rssi.run(args, robot, peer, directory)
    with opened({robot: directory}) as opened_buses:
        series = _measure(opened_buses[robot], robot, peer, args)
    if args.json:
        print(json.dumps({"robot": robot, "what": args.what, "series": [asdict(each) for each in series]}))
    else:
        write_lines(show.table(robot, args.what, series))
    if args.plot is not None:
        show.draw(args.plot, robot, args.what, series)
    return 1 if any(not row.samples for each in series for row in each.figures) else 0


def _ends(args: argparse.Namespace) -> tuple[str, str, Path]:
    """From which robot to which, and the first one's runtime directory."""
    ends: list[str] = args.ends
    if len(ends) == 1:
        first, dash, second = ends[0].partition("-")
        # A name may have a dash: then the long form helps.
        ends = [first, second] if args.robot is None and dash and is_name(first) else ends
    peer = ends[-1]
    if len(ends) == 2:
        if args.robot not in (None, ends[0]):
            raise LocalError(f"--robot {args.robot} is not {ends[0]}, where it is to begin")
        args.robot = ends[0]
    directories = buses.find(args)
    if len(directories) != 1 or len(ends) > 2:
        raise LocalError(f"from which robot to which? write for example {next(iter(directories))} {peer}")
    ((robot, directory),) = directories.items()
    if not is_name(peer) or peer == robot:
        raise LocalError(f"{' '.join(ends)}: expected two robots like r0 r1")
    return robot, peer, directory


def _measure(bus: Bus, robot: str, peer: str, args: argparse.Namespace) -> list[Series]:
    series = []
    for sender, overlay, to, hops in _ways(bus, robot, peer, args.overlay, args.priority):
        if args.what == "rtt":
            figures = sender.rtt(args.sizes, args.count)
        else:
            figures = sender.throughput(args.sizes, max(1, args.count // 10))
        series.append(Series(overlay, to, hops, figures))
    return series


def _ways(
    bus: Bus, robot: str, peer: str, overlay: str | None, priority: str | None
) -> list[tuple[Sender, str, str, int]]:
    """What is to be measured: how, over which overlay, to whom, over how many links."""
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
    views = MeshViews()
    views.ask(robot, bus, PATIENCE)
    with views.changed:
        if not views.changed.wait_for(lambda: robot in views.robots, PATIENCE):
            raise LocalError(f"the mesh of {robot} does not answer ({PATIENCE:g} s)")
    return views.best()


def path(known: Mapping[str, GraphRobot], robot: str, peer: str) -> list[str]:
    """The robots from a neighbour of `robot` to `peer`: a shortest way, the one that unicast takes or one as long;
    `LocalError` where there is none."""
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


def _sizes(text: str) -> tuple[int, ...]:
    # How long a message may be is the mesh's matter: it refuses, and says why.
    parts = text.split(",")
    if all(part.isdecimal() and int(part) >= 1 for part in parts):
        return tuple(dict.fromkeys(map(int, parts)))
    raise argparse.ArgumentTypeError(f"{text!r}: expected numbers of bytes, like 50,200,1000")


def _count(text: str) -> int:
    if text.isdecimal() and 1 <= int(text) <= 10_000:
        return int(text)
    raise argparse.ArgumentTypeError(f"{text!r}: expected a number from 1 to 10000")
