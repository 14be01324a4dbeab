"""The tables of `swarm mesh`: of the robots, of the links, of the overlays' counters, and the graph."""

import statistics
from collections.abc import Sequence

from swarm.messages import LinkState, MeasuredHub
from swarm.onboard.buses.ask import AWAY
from swarm.onboard.mesh.collected import CollectedMesh
from swarm.process.terminal import columns

MATRIX_UP_TO = 16
"""Robots whose links are shown as a matrix; more as a list."""

OVERLAYS = (
    ("floods", "flood_sent"),
    ("copies", "flood_duplicates"),
    ("flooded again", "flood_retries"),
    ("repaired", "repaired"),
    ("forwarded", "unicast_forwarded"),
    ("rerouted", "unicast_rerouted"),
    ("sent again", "unicast_retries"),
    ("no path", "unicast_no_route"),
    ("not admitted", "unicast_refused"),
    ("bad packets", "bad_packets"),
)
"""Columns and counters of the table of overlays (docs/reference/network/overlay-packets.md)."""


def text(mesh: CollectedMesh) -> list[str]:
    """Return the lines of all tables."""
    return [*clashes(mesh), *robots(mesh), "", *links(mesh), "", *overlays(mesh), "", *graph(mesh)]


def clashes(mesh: CollectedMesh) -> list[str]:
    """Return one line for each name that two robots have."""
    return [f"WRONG: {text}" for _, text in sorted(mesh.clashes.items())]


def robots(mesh: CollectedMesh) -> list[str]:
    """Return one line for each robot of the swarm."""
    rows: list[Sequence[str]] = [("robot", "state", "hops", "via", "links", "stopped", "clock")]
    neighbours = {name: len(mesh.graph.neighbours(name)) for name in mesh.names}
    one_view = len(mesh.views) == 1
    for name in mesh.names:
        known, view = mesh.robots.get(name), mesh.views.get(name)
        told = view.clock if view is not None else None
        rows.append(
            (
                name,
                _state_word(mesh, name),
                str(known.hops) if one_view and known is not None and known.hops is not None else "",
                (known.via or "") if one_view and known is not None else "",
                str(neighbours[name]),
                "" if known is None else {True: "yes", False: "no", None: "-"}[known.stopped],
                "" if told is None else f"{told.root}+{told.hop} ±{told.error * 1e3:.1f} ms",
            )
        )
    return columns(rows)


def _state_word(mesh: CollectedMesh, name: str) -> str:
    """Return a robot's state in a word. `self` is told only where one robot was asked, and is `here` otherwise."""
    known, view = mesh.robots.get(name), mesh.views.get(name)
    if view is not None and view.links is None:
        return "silent"
    if known is None:
        return "?"
    return "here" if known.state == "self" and len(mesh.views) != 1 else known.state


def links(mesh: CollectedMesh) -> list[str]:
    """Return one line for each end of each link of the robots that were asked; with roles where there are any."""
    roles = any(link.role for _, link in mesh.links())
    rows: list[Sequence[str]] = [
        (
            "link",
            "state",
            "connected",
            "rtt min",
            "median",
            "p99 ms",
            "out",
            "in B/s",
            "queue",
            "window",
            "lost",
            "refused",
            *(["role"] if roles else []),
            "reason",
        ),
    ]
    for name, link in mesh.links():
        rows.append(
            (
                f"{name} {link.peer}",
                link.state,
                str(link.connection),
                ms(link.rtt_min),
                ms(link.rtt_median),
                ms(link.rtt_p99),
                f"{link.sent_rate:.0f}",
                f"{link.received_rate:.0f}",
                str(link.queue),
                str(link.window),
                str(link.dropped),
                str(link.refused),
                *([role(link)] if roles else []),
                link.reason,
            )
        )
    return columns(rows)


def role(link: LinkState) -> str:
    """Return this end's role in a Bluetooth connection, and which one is wanted in its place."""
    return link.role if link.role == link.wanted_role else f"{link.role}, wanted {link.wanted_role}"


def overlays(mesh: CollectedMesh) -> list[str]:
    """Return one line for each robot that was asked. The overlays repeat lost messages; the links do not."""
    rows: list[Sequence[str]] = [
        ("since start", *(column for column, _ in OVERLAYS), "callers refused"),
    ]
    for name, view in mesh.views.items():
        if view.counters is not None:
            counters = view.counters
            refused = sum(
                count for each, count in counters.items() if each.startswith("refused_") or each == "half_open"
            )
            rows.append((name, *(str(counters.get(each, 0)) for _, each in OVERLAYS), str(refused)))
    return columns(rows)


def graph(mesh: CollectedMesh) -> list[str]:
    """Return the matrix of links with the round trip in ms; `x` = not up."""
    cells: dict[tuple[str, str], str] = {}
    for pair in mesh.states:
        shown = (ms(mesh.round_trips[pair]) or "up") if pair in mesh.round_trips else "x"
        cells[pair] = cells[pair[::-1]] = shown
    names = mesh.names
    if len(names) <= MATRIX_UP_TO:
        width = max(5, *map(len, names)) + 1
        lines = ["rtt ms".ljust(width) + "".join(name.rjust(width) for name in names)]
        for row in names:
            line = "".join(("." if row == column else cells.get((row, column), "-")).rjust(width) for column in names)
            lines.append(row.ljust(width) + line)
    else:
        lines = [
            f"{row}: " + ", ".join(f"{peer} {cell}" for (end, peer), cell in sorted(cells.items()) if end == row)
            for row in names
        ]
    return [*lines, "", _summary(mesh), *(_hubs(mesh) if mesh.carried else ())]


def _hubs(mesh: CollectedMesh) -> list[str]:
    """Name the neighbours where hubs carry the topology, whom the hubs call, and what stands in for links of hubs."""
    calls = ", ".join(f"{hub} calls {' '.join(robots)}" for hub, robots in mesh.hubs.items())
    lines = [f"neighbours {pairs(mesh.carried)}, over hubs: {calls}"]
    if mesh.measured_hub is not None:
        lines.append(_choice(mesh.measured_hub))
    for (hub, robot), (reason, others) in mesh.replaced.items():
        instead = f"{robot} has a link with {' '.join(others)}" if others else f"nothing leads to {robot}"
        lines.append(f"no link {pairs([(hub, robot)])} ({reason}): {instead} instead")
    return lines


def _choice(hub: MeasuredHub) -> str:
    """Say which hub was chosen, and by which round trips."""
    trial = " (on trial)" if hub.trial else ""
    before = f"before it {hub.before}, {_mean(hub.round_trip_before)}" if hub.before else "no other was tried"
    return f"hub by measurement: {hub.robot}{trial}, mean round trip {_mean(hub.round_trip)}; {before}"


def _mean(seconds: float | None) -> str:
    return "not known" if seconds is None else f"{ms(seconds)} ms"


def pairs(edges: Sequence[Sequence[str]]) -> str:
    """Return links as `swarm mesh topology set` takes them."""
    return " ".join(f"{a}-{b}" if "-" not in a + b else f"{a}:{b}" for a, b in edges)


def ms(seconds: float | None) -> str:
    """Return milliseconds as text; empty for None."""
    return "" if seconds is None else f"{seconds * 1e3:.1f}"


def _summary(mesh: CollectedMesh) -> str:
    parts = mesh.graph.components()
    times = [time for time in mesh.round_trips.values() if time is not None]
    away = [f"{name} ({robot.state})" for name, robot in mesh.robots.items() if robot.state in AWAY]
    line = f"{len(mesh.names)} robots, {len(mesh.round_trips)} of {len(mesh.states)} links up"
    if times:
        line += f", median round trip {statistics.median(times) * 1e3:.1f} ms"
    if len(parts) == 1:
        line += f", diameter {mesh.graph.diameter()}"
    else:
        line += f"; {len(parts)} parts: " + "; ".join(" ".join(part) for part in parts)
    return line + (f"; away: {' '.join(away)}" if away else "")
