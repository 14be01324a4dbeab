"""The mesh: robots, the links between them, and how good these are."""

import math
from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

from laptop.plotting import style
from laptop.plotting.places import Place, frame, paths
from swarm.core.graph import Edge, pair_of
from swarm.errors import LocalError
from swarm.recording.run import Run, natural

CROWD = 24
"""Number of links or robots from which on the mesh is drawn without labels."""

INSIDE = 4
"""The most letters of a name that stands in its robot's circle."""

APART = 0.15
"""Distance below which two drawn robots hide each other, m."""
BESIDE = 0.12
"""Distance from a link, as a share of the picture, below which a third robot seems to belong to it."""
ALONG = (0.5, 0.4, 0.6, 0.3, 0.7, 0.22, 0.78)
"""Places on a link where its label may stand, the best one first."""
CLEAR = 0.13
"""Least distance of a label from other labels, robots and crossings, as a share of the picture."""


class DrawnLink(NamedTuple):
    """A link as it is drawn."""

    up: bool
    rtt: float | None
    """Round-trip time, s."""
    text: str = ""
    """Text on the link besides the round-trip time."""


def mesh(figure: Any, run: Run) -> None:
    """Draw the links between the robots as they were at the end. Colour and words tell the mean round-trip time, and a
    dashed link is down. Messages that a link has dropped while it was recorded are counted."""
    seen: dict[Edge, dict[str, list[dict[str, Any]]]] = {}
    newest: dict[str, list[str]] = {}
    """The peers of each robot by its newest message: a link that the swarm does not want any more is not in it."""
    for sample in run.samples("swarm/*/mesh/links"):
        robot = sample.topic.split("/")[1]
        newest[robot] = [link["peer"] for link in sample.message["links"]]
        for link in sample.message["links"]:
            seen.setdefault(pair_of(robot, link["peer"]), {}).setdefault(robot, []).append(link)
    ends: dict[Edge, list[list[dict[str, Any]]]] = {}
    for robot, peers in newest.items():
        for peer in peers:
            ends.setdefault(pair_of(robot, peer), []).append(seen[pair_of(robot, peer)][robot])
    if not newest:
        raise LocalError(f"no state of the mesh's links is recorded{style.DEVICES}")
    if not ends:
        raise LocalError("at the end no robot had a link")
    names = sorted({name for pair in ends for name in pair}, key=natural)
    places = layout(names, list(ends), {name: track[-1][0] for name, track in paths(run).items()})
    links = {}
    for pair, each in ends.items():
        up = all(end[-1]["state"] in ("up", "suspect") for end in each)
        lost = sum(_increase([link.get("dropped", 0) for link in end]) for end in each)
        links[pair] = DrawnLink(up, _rtt(each), f"{lost} dropped" if lost else "")
    figure.set_size_inches(5.6, 4.6)
    network(figure, places, links)


def _increase(counts: Sequence[int]) -> int:
    """Return by how much a counter has grown. It begins anew with each mesh process."""
    return sum(new - old if new >= old else new for old, new in pairwise(counts))


def network(
    figure: Any, places: Mapping[str, Place], links: Mapping[Edge, DrawnLink], faces: Mapping[str, str] | None = None
) -> None:
    """Draw robots at their places, in the colours of `faces` (white), and the links between them."""
    axes = figure.add_subplot()
    from matplotlib import colormaps
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    known = [link.rtt for link in links.values() if link.rtt is not None]
    scale = Normalize(0.0, 1e3 * max(known, default=1.0) * 1.05)
    ramp = colormaps["cividis_r"]
    crowded = max(len(links), len(places)) > CROWD
    words = {} if crowded else spots(places, list(links))
    for pair, link in links.items():
        axes.plot(
            *zip(*(places[name] for name in pair), strict=True),
            color=style.GREY if link.rtt is None else ramp(scale(1e3 * link.rtt)),
            linewidth=0.8 if crowded else 3.0 if link.up else 1.2,
            linestyle="-" if link.up else "--",
            zorder=1,
        )
        if pair in words:
            text = "down" if not link.up else "" if link.rtt is None else f"{1e3 * link.rtt:.0f} ms"
            box = {"boxstyle": "round,pad=0.15", "fc": "white", "ec": "none", "alpha": 0.9}
            whole = "\n".join(filter(None, (text, link.text)))
            axes.annotate(whole, words[pair], ha="center", va="center", fontsize=7.5, zorder=2, bbox=box)
    for name, (x, y) in places.items():
        face = (faces or {}).get(name, "white")
        axes.plot(x, y, "o", color=face, markeredgecolor="black", markersize=5 if crowded else 21, zorder=3)
        if not crowded:
            below = len(name) > INSIDE
            axes.annotate(
                name,
                (x, y),
                textcoords="offset points",
                xytext=(0.0, -12.0 if below else 0.0),
                ha="center",
                va="top" if below else "center",
                fontsize=8.5,
                zorder=4,
                bbox={"fc": "white", "ec": "none", "alpha": 0.7, "pad": 0.5} if below else None,
            )
    if known:
        bar = figure.colorbar(ScalarMappable(scale, ramp), ax=axes, shrink=0.75, pad=0.02)
        bar.set_label("round-trip time / ms")
        bar.outline.set_visible(False)
    frame(axes, list(places.values()))
    axes.set(aspect="equal")
    axes.axis("off")


def layout(names: list[str], links: list[Edge], real: Mapping[str, Place]) -> dict[str, Place]:
    """Return the places of robots where all are known, apart, and none seems to be on a link of others; else places on
    a circle."""
    places = {name: real[name] for name in names if name in real}
    if len(places) == len(names):
        size = _size(places)
        apart = all(math.dist(places[a], places[b]) > APART for a in names for b in names if a < b)
        beside = (_off(places[n], places[a], places[b]) for a, b in links for n in names if n not in (a, b))
        if apart and all(distance > BESIDE * size for distance in beside):
            return places
    turn = 2 * math.pi / len(names)
    return {name: (math.sin(index * turn), math.cos(index * turn)) for index, name in enumerate(names)}


def spots(places: Mapping[str, Place], links: list[Edge]) -> dict[Edge, Place]:
    """Return the place of the words of each link: on it, clear of robots, other links and other words, as far as
    possible."""
    size = _size(places)
    found: dict[Edge, Place] = {}
    for a, b in links:
        (xa, ya), (xb, yb) = places[a], places[b]
        near = [places[name] for name in places]
        others = [(places[c], places[d]) for c, d in links if not {a, b} & {c, d}]
        best: tuple[float, Place] | None = None
        for share in ALONG:
            spot = xa + share * (xb - xa), ya + share * (yb - ya)
            free = min(
                (math.dist(spot, place) for place in (*near, *found.values())),
                default=size,
            )
            free = min([free, *(_off(spot, *other) for other in others)])
            if best is None or free > best[0] + 1e-9:
                best = free, spot
            if free > CLEAR * size:
                break
        assert best is not None
        found[a, b] = best[1]
    return found


def _size(places: Mapping[str, Place]) -> float:
    xs, ys = zip(*places.values(), strict=True)
    size: float = max(max(xs) - min(xs), max(ys) - min(ys), 1e-6)
    return size


def _off(place: Place, a: Place, b: Place) -> float:
    """Return the distance of a place from the line between two others."""
    (x, y), (xa, ya), (xb, yb) = place, a, b
    squared = (xb - xa) * (xb - xa) + (yb - ya) * (yb - ya)
    share = max(0.0, min(1.0, ((x - xa) * (xb - xa) + (y - ya) * (yb - ya)) / squared)) if squared else 0.0
    return math.hypot(x - xa - share * (xb - xa), y - ya - share * (yb - ya))


def _rtt(ends: Iterable[list[dict[str, Any]]]) -> float | None:
    found: list[float] = [link["rtt"] for seen in ends for link in seen if link.get("rtt") is not None]
    return math.fsum(found) / len(found) if found else None
