"""`swarm mesh`: who is in the swarm and how it is linked, as any one robot knows it, with the details of the links of
those robots whose buses can be reached: all of a simulation, or this one."""

import argparse
import contextlib
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path

from swarm.bus.protocol import OnSample
from swarm.bus.zenoh_bus import Bus
from swarm.errors import LocalError, PayloadError
from swarm.messages import Clock, Links, Status, Topology, read
from swarm.messages.keys import key, parse
from swarm.onboard.buses import buses
from swarm.onboard.buses.ask import PATIENCE, Views, opened
from swarm.onboard.mesh import tables
from swarm.onboard.mesh.collected import CollectedMesh, MeshView
from swarm.process.arguments import add_json, show


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare `[--robots r0,r3] [--run-dir DIR] [--radio] [--json]`."""
    buses.add_arguments(parser)
    parser.add_argument("--radio", action="store_true", help="show what the Bluetooth adapter tells of its connections")
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Print what is known; code 1 where a mesh says nothing, a robot is away or a link is not up."""
    return 0 if shown(args).whole else 1


def shown(args: argparse.Namespace) -> CollectedMesh:
    """Print what is known, and return it."""
    directories = buses.directories_of(args)
    mesh = collect(directories)
    data, text = as_json(mesh), tables.text(mesh)
    if args.radio:
        from swarm.onboard.mesh import radio  # asks the adapter: most uses of `swarm mesh` do without

        readings = radio.read(directories)
        data["radio"] = [asdict(each) for each in readings]
        text += ["", *radio.table(readings)]
    show(args, data, text)
    return mesh


def collect(directories: Mapping[str, Path]) -> CollectedMesh:
    """Wait for the newest reports of these robots, and return them. Raises `LocalError` where no mesh reports at
    all."""
    views = {name: MeshView() for name in directories}
    graphs = Views()

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
                elif isinstance(message, Topology):
                    view.topology = message
                graphs.changed.notify_all()

    with opened(directories) as opened_buses:
        for name, bus in opened_buses.items():
            bus.subscribe(key(name, "mesh", "links"), take)
            bus.on_change(lambda up, name=name, bus=bus: _ask(name, bus, graphs, take) if up else None)  # type: ignore[misc]
        with graphs.changed:
            graphs.changed.wait_for(
                lambda: all(view.complete and name in graphs.robots for name, view in views.items()), PATIENCE
            )
    if not any(view.links for view in views.values()) and not graphs.robots:
        raise LocalError(
            f"no mesh reports its links: {', '.join(directories)} ({PATIENCE:g} s); does it run? (swarm status)"
        )
    return CollectedMesh(views, graphs.best())


def _ask(name: str, bus: Bus, graphs: Views, take: OnSample) -> None:
    graphs.ask(name, bus, PATIENCE)
    for topic in ("clock", "status", "topology"):
        bus.ask(key(name, "mesh", topic), take, timeout_s=PATIENCE)


def as_json(mesh: CollectedMesh) -> dict[str, object]:
    """Return the swarm as values for JSON."""
    robots: dict[str, dict[str, object]] = {}
    for name in mesh.names:
        known, view = mesh.robots.get(name), mesh.views.get(name)
        entry: dict[str, object] = asdict(known) if known is not None else {"robot": name}
        entry["told"] = entry.pop("links", {})
        if view is not None:
            entry["links"] = None if view.links is None else [asdict(link) for link in view.links.links]
            entry["clock"] = None if view.clock is None else asdict(view.clock)
            entry["counters"] = view.counters
        robots[name] = entry
    edges = [{"ends": list(ends), "round_trip": time} for ends, time in sorted(mesh.round_trips.items())]
    return {
        "robots": robots,
        "edges": edges,
        "carried": [list(ends) for ends in mesh.carried],
        "hub": None if mesh.measured_hub is None else asdict(mesh.measured_hub),
        "clashes": mesh.clashes,
        "parts": [list(part) for part in mesh.graph.components()],
    }
