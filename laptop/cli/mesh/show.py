"""`swarm mesh`: who is in the swarm and how it is linked, as any one robot knows it, with the details of the links of
those robots whose buses can be reached: all of a simulation, or this one."""

import argparse
import contextlib
import dataclasses
import json
from collections.abc import Mapping
from pathlib import Path

from laptop.cli.mesh import tables
from laptop.cli.mesh.collected import CollectedMesh, MeshView
from laptop.cli.mesh.survey import PATIENCE, MeshViews, opened
from swarm import clock
from swarm.bus.zenoh_bus import Bus, OnSample
from swarm.errors import LocalError, PayloadError
from swarm.messages import Clock, Links, Status, read
from swarm.messages.keys import key, parse
from swarm.onboard import buses
from swarm.process.terminal import write_lines

HELP = "the robots of the swarm, their links, and the graph they make"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """`[--robot NAME] [--run-dir DIR] [--plot FILE] [--json]`."""
    buses.add_arguments(parser)
    parser.add_argument("--plot", type=Path, metavar="FILE", help="draw the graph: .png, .pdf or .svg")
    parser.add_argument("--json", action="store_true", help="one JSON object")


def run(args: argparse.Namespace) -> int:
    """Print what is known; code 1 where a mesh says nothing, a robot is away or a link is not up."""
    mesh = collect(buses.find(args))
    if args.json:
        print(json.dumps(as_json(mesh)))
    else:
        write_lines(tables.text(mesh))
    if args.plot is not None:
        from laptop.cli.mesh.graph_plot import draw

        draw(mesh, args.plot)
    return 0 if mesh.whole else 1


def collect(directories: Mapping[str, Path]) -> CollectedMesh:
    """The newest reports of these robots, waited for; `LocalError` where no mesh reports at all."""
    views = {name: MeshView() for name in directories}
    graphs = MeshViews()

    def take(text: str, payload: bytes) -> None:
        with contextlib.suppress(PayloadError):
            view, message = views[parse(text).robot], read(text, payload)
            with graphs.changed:
                if isinstance(message, Links):
                    view.links = message
                elif isinstance(message, Clock):
                    view.clock = message
                elif isinstance(message, Status):
                    view.counters = message.counters
                graphs.changed.notify_all()

    with opened(directories) as opened_buses:
        for name, bus in opened_buses.items():
            bus.subscribe(key(name, "mesh", "links"), take)
            bus.on_change(lambda up, name=name, bus=bus: _ask(name, bus, graphs, take) if up else None)  # type: ignore[misc]
        end = clock.now() + PATIENCE
        with graphs.changed:
            while clock.now() < end:
                if all(view.complete and name in graphs.robots for name, view in views.items()):
                    break
                graphs.changed.wait(max(0.0, end - clock.now()))
    if not any(view.links for view in views.values()) and not graphs.robots:
        raise LocalError(f"no mesh reports its links: {', '.join(directories)} ({PATIENCE:g} s)")
    return CollectedMesh(views, graphs.best())


def _ask(name: str, bus: Bus, graphs: MeshViews, take: OnSample) -> None:
    graphs.ask(name, bus, PATIENCE)
    for topic in ("clock", "status"):
        bus.ask(key(name, "mesh", topic), take, timeout_s=PATIENCE)


def as_json(mesh: CollectedMesh) -> dict[str, object]:
    """For programs."""
    robots: dict[str, dict[str, object]] = {}
    for name in mesh.names:
        known, view = mesh.robots.get(name), mesh.views.get(name)
        entry: dict[str, object] = dataclasses.asdict(known) if known is not None else {"robot": name}
        entry["told"] = entry.pop("links", {})
        if view is not None:
            links = None if view.links is None else [dataclasses.asdict(link) for link in view.links.links]
            entry |= {
                "links": links,
                "clock": None if view.clock is None else dataclasses.asdict(view.clock),
                "counters": view.counters,
            }
        robots[name] = entry
    edges = [{"ends": list(ends), "round_trip": time} for ends, time in sorted(mesh.round_trips.items())]
    return {
        "robots": robots,
        "edges": edges,
        "clashes": mesh.clashes,
        "parts": [list(part) for part in mesh.graph.components()],
    }
