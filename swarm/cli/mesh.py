"""`swarm mesh`: the links of all simulated robots, or of this robot, as a table, and the graph they make."""

import argparse
import contextlib
import dataclasses
import json
import statistics
import threading
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from swarm import clock
from swarm.bus import Bus
from swarm.cli import buses
from swarm.core.graph import Graph
from swarm.errors import LocalError, PayloadError
from swarm.keys import key, parse
from swarm.messages import Clock, Links, LinkState, read

HELP = "table of the mesh's links, and the graph they make"

PATIENCE = 3.0
"""s to wait for reports: every mesh makes one a second."""

_MATRIX_UP_TO = 16
"""Robots whose links are shown as a matrix; more as a list."""


@dataclass
class View:
    """What one robot's mesh reports."""

    links: Links | None = None
    clock: Clock | None = None


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """`[--robot NAME] [--run-dir DIR] [--json]`."""
    buses.add_arguments(parser)
    parser.add_argument("--json", action="store_true", help="one JSON object")


def run(args: argparse.Namespace) -> int:
    """Print what all robots say; code 1 where one says nothing or a link is not up."""
    views = collect(buses.find(args))
    if args.json:
        print(json.dumps(as_json(views)))
    else:
        print("\n".join([*table(views), "", *graph(views)]))
    silent = [name for name, view in views.items() if view.links is None]
    return 1 if silent or any(link.state != "up" for _, link in _links(views)) else 0


def collect(directories: Mapping[str, Path]) -> dict[str, View]:
    """The newest reports of these robots, waited for; `LocalError` where no mesh reports at all."""
    views = {name: View() for name in directories}
    changed = threading.Condition()

    def take(text: str, payload: bytes) -> None:
        with contextlib.suppress(PayloadError):
            view, message = views[parse(text).robot], read(text, payload)
            with changed:
                if isinstance(message, Links):
                    view.links = message
                elif isinstance(message, Clock):
                    view.clock = message
                changed.notify()

    with contextlib.ExitStack() as stack:
        for name, directory in directories.items():
            bus = stack.enter_context(Bus.of(directory))
            bus.subscribe((key(name, "mesh", "links"), key(name, "mesh", "clock")), take)
        end = clock.now() + PATIENCE
        with changed:
            while not all(view.links and view.clock for view in views.values()) and clock.now() < end:
                changed.wait(max(0.0, end - clock.now()))
    if not any(view.links for view in views.values()):
        raise LocalError(f"no mesh reports its links: {', '.join(directories)} ({PATIENCE:g} s)")
    return views


def as_json(views: Mapping[str, View]) -> dict[str, object]:
    """For programs."""
    robots = {}
    for name, view in views.items():
        links = None if view.links is None else [dataclasses.asdict(link) for link in view.links.links]
        robots[name] = {"links": links, "clock": None if view.clock is None else dataclasses.asdict(view.clock)}
    return {"robots": robots, "parts": [list(part) for part in _graph(views).components()]}


def table(views: Mapping[str, View]) -> list[str]:
    """One line for each end of each link."""
    rows: list[tuple[str, ...]] = [
        ("robot", "peer", "state", "links", "rtt min", "median", "p99 ms", "out", "in B/s", "queue", "window", "lost",
         "refused", "clock", "why"),
    ]  # fmt: skip
    for name, view in views.items():
        if view.links is None:
            rows.append((name, "-", "silent", *[""] * 12))
            continue
        told = "" if view.clock is None else f"{view.clock.root}+{view.clock.hop} ±{view.clock.error * 1e3:.1f} ms"
        for number, link in enumerate(view.links.links):
            rows.append(
                (
                    name if not number else "",
                    link.peer,
                    link.state,
                    str(link.connection),
                    _ms(link.rtt_min),
                    _ms(link.rtt_median),
                    _ms(link.rtt_p99),
                    f"{link.sent_rate:.0f}",
                    f"{link.received_rate:.0f}",
                    str(link.queue),
                    str(link.window),
                    str(link.dropped),
                    str(link.refused),
                    told if not number else "",
                    link.reason,
                )
            )
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    return ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]


def graph(views: Mapping[str, View]) -> list[str]:
    """Who is linked to whom, with the median round trip in ms; `x` = not up."""
    names = _names(views)
    cells: dict[tuple[str, str], str] = {}
    for name, link in _links(views):
        here = _ms(link.rtt_median) or "up" if link.state in ("up", "suspect") else "x"
        cells[name, link.peer] = here
        # The other end's word where it is not asked itself.
        cells.setdefault((link.peer, name), here)
    if len(names) <= _MATRIX_UP_TO:
        width = max(5, *map(len, names)) + 1
        lines = [" " * width + "".join(name.rjust(width) for name in names)]
        for row in names:
            line = "".join(("." if row == column else cells.get((row, column), "-")).rjust(width) for column in names)
            lines.append(row.ljust(width) + line)
    else:
        lines = [
            f"{row}: " + ", ".join(f"{peer} {cell}" for (end, peer), cell in sorted(cells.items()) if end == row)
            for row in names
        ]
    return [*lines, "", _summary(views, names)]


def _summary(views: Mapping[str, View], names: tuple[str, ...]) -> str:
    found = _graph(views)
    parts = found.components()
    known = {frozenset((name, link.peer)) for name, link in _links(views)}
    medians = [link.rtt_median for _, link in _links(views) if link.rtt_median is not None]
    text = f"{len(names)} robots, {len(found.edges)} of {len(known)} links up"
    if medians:
        text += f", median round trip {statistics.median(medians) * 1e3:.1f} ms"
    if len(parts) == 1:
        return f"{text}, diameter {found.diameter()}"
    return f"{text}; {len(parts)} parts: " + "; ".join(" ".join(part) for part in parts)


def _graph(views: Mapping[str, View]) -> Graph:
    """The links that no end says are down."""
    state: dict[tuple[str, str], bool] = {}
    for name, link in _links(views):
        pair = (min(name, link.peer), max(name, link.peer))
        state[pair] = state.get(pair, True) and link.state in ("up", "suspect")
    return Graph(_names(views), [pair for pair, up in state.items() if up])


def _names(views: Mapping[str, View]) -> tuple[str, ...]:
    return tuple(sorted({*views, *(link.peer for _, link in _links(views))}))


def _links(views: Mapping[str, View]) -> Iterator[tuple[str, LinkState]]:
    for name, view in views.items():
        if view.links is not None:
            for link in view.links.links:
                yield name, link


def _ms(seconds: float | None) -> str:
    return "" if seconds is None else f"{seconds * 1e3:.1f}"
