"""`swarm mesh [--plot FILE]` on a laptop: what a robot shows of the swarm, and the graph of the links as a picture."""

import argparse
import math
from pathlib import Path

from laptop.plotting.style import add_plot, figure
from swarm.core.graph import Graph
from swarm.onboard.buses.ask import AWAY
from swarm.onboard.mesh import show
from swarm.onboard.mesh.collected import CollectedMesh

ON_A_CIRCLE = 12
"""The most robots that are drawn on a circle, where every link can be seen. More robots are placed by their
distances."""

Place = tuple[float, float]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare what a robot's command takes, and `--plot`."""
    show.add_arguments(parser)
    add_plot(parser)


def run(args: argparse.Namespace) -> int:
    """Print what is known of the mesh. Return 1 where a mesh says nothing, a robot is away or a link is not up."""
    mesh = show.shown(args)
    if args.plot is not None:
        draw(mesh, args.plot)
    return 0 if mesh.whole else 1


def draw(mesh: CollectedMesh, path: Path) -> None:
    """Write the picture; `LocalError` where matplotlib is not there, or the file cannot be written."""
    from laptop.plotting.mesh import DrawnLink, network  # reads recordings, too: most uses of `swarm mesh` do without

    links = {pair: DrawnLink(up, mesh.round_trips.get(pair)) for pair, up in sorted(mesh.states.items())}
    faces = {name: "#bbbbbb" for name, robot in mesh.robots.items() if robot.state in AWAY}
    faces |= {name: "#e69f00" for name, robot in mesh.robots.items() if robot.stopped and name not in faces}
    with figure(path, figsize=(7, 6), layout="constrained") as picture:
        network(picture, places(mesh.graph), links, faces)
        picture.suptitle("grey: away, orange: stopped")


def places(graph: Graph) -> dict[str, Place]:
    """Return the place of each robot in the picture: on a circle, or such that distances are near the numbers of
    links between robots (classical multidimensional scaling: Torgerson 1952). Parts that are not linked are drawn
    apart."""
    names = graph.names
    if len(names) <= ON_A_CIRCLE:
        angles = [math.pi / 2 - 2 * math.pi * number / len(names) for number in range(len(names))]
        return {name: (math.cos(angle), math.sin(angle)) for name, angle in zip(names, angles, strict=True)}
    import numpy as np

    from services.dwm.anchors.autoposition import scaled  # needs numpy, too

    hops = [graph.distances(name) for name in names]
    far = 1 + max(distance for row in hops for distance in row.values())
    plane = scaled(np.array([[row.get(name, far) for name in names] for row in hops], dtype=float))
    return {name: (float(x), float(y)) for name, (x, y) in zip(names, plane, strict=True)}
