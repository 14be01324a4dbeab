"""Consensus of whole swarms over the slot radio, by the services' own cores in virtual time."""

import math
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import NamedTuple, cast

from bench.rows import number
from services.apps.host.observer import Source, StepRecord
from sim.scenario.options import parse
from sim.scenario.scenario import build
from sim.virtual.bus import VirtualBus
from sim.virtual.radio.mesh import VirtualMesh
from sim.virtual.radio.slot_air import SlotAir
from sim.virtual.run import PLACE, VirtualRun, run_virtually
from swarm.app.overlays import Overlays

DROP = ("--absent", "drop", "--drop-after", "3")

SETTLED = 10.0
"""s from the first iteration until a run counts as quiet: all links are up, clocks are joined."""

CHOSEN = 140.0
"""s after which a trial of another hub has ended."""

SIZE = 960_000
"""Bytes of a large message: the bus takes 983 040, with the request around them."""


def consensus(
    graph: str, iterations: int, seed: int, *, links: str, radio: str = "slots", more: tuple[str, ...] = ()
) -> dict[str, object]:
    """Return the report of one run on a graph such as `loop 6`."""
    shape, robots = graph.split()
    words = f"consensus --robots {robots} --topology {shape} --iterations {iterations} --seed {seed}"
    report, _ = run_virtually(*words.split(), "--radio", radio, "--links", links, *more)
    return report


def pace(graph: str, iterations: int, seed: int, *, links: str, radio: str = "slots") -> float:
    """Return s an iteration."""
    report = consensus(graph, iterations, seed, links=links, radio=radio)
    return number(report, "seconds") / max(1.0, number(report, "iterations"))


def start(graph: str, seed: int, *, links: str) -> float:
    """Return s until all robots iterate; infinite where they do not."""
    report = consensus(graph, 1, seed, links=links)
    return math.inf if report["problems"] else number(report, "started_s")


class Watched:
    """A run of so many virtual seconds from its first iteration on, and when r1 had its iterations."""

    def __init__(self, graph: str, seconds: float, seed: int, *more: str) -> None:
        """`graph`: shape and number of robots, such as `loop 6`."""
        shape, robots = graph.split()
        words = (
            f"consensus --virtual --radio slots --robots {robots} --topology {shape} --seconds {seconds} --seed {seed}"
        )
        options = parse([*words.split(), *more])
        self.run = VirtualRun(options, build(options, PLACE))
        self.moments: list[float] = []
        self._advanced = self.run.advanced
        self.run.advanced = self._note  # type: ignore[method-assign]

    def _note(self, source: Source, line: StepRecord) -> None:
        if source.robot == "r1":
            self.moments.append(self.run.world.time.now)
        self._advanced(source, line)

    def pace(self, since: float, until: float = math.inf) -> float:
        """Return s an iteration between two moments."""
        found = [moment for moment in self.moments if since <= moment < until]
        return (found[-1] - found[0]) / (len(found) - 1)


def fail_over(graph: str, seed: int) -> float:
    """Return the longest time without an iteration, s, of a run whose hub is switched off for good."""
    watched = Watched(graph, 30.0, seed, *DROP, "--links", "auto", "--off", "r0@10s,1000s")
    watched.run.go()
    return max(after - before for before, after in pairwise(watched.moments))


def long_pace(graph: str, seconds: float, seed: int, *, absent: str = "") -> float:
    """Return s an iteration over so many seconds; `absent` is a robot that is never there."""
    away = (*DROP, "--off", f"{absent}@start,100000s") if absent else ()
    watched = Watched(graph, seconds, seed, "--links", "auto", *away)
    watched.run.go()
    return watched.pace(watched.moments[0] + SETTLED)


class Trouble(NamedTuple):
    """What is wrong around the hub."""

    losses: Mapping[frozenset[str], float]
    """Probabilities of pairs of robots that a packet is lost."""
    unheard: Sequence[tuple[str, str]] = ()
    """Pairs of robots that do not hear each other."""


def troubled(graph: str, seconds: float, seed: int, trouble: Trouble, *, links: str) -> tuple[float, str]:
    """Return s an iteration over the last part of a run, from `CHOSEN` s on, and which robot is the hub then."""
    watched = Watched(graph, seconds, seed, "--links", links)
    world = watched.run.world
    air = cast(SlotAir, world.air)
    air.radio.losses.update(trouble.losses)
    for a, b in trouble.unheard:
        air.cut(a, b, math.inf)
    watched.run.go()
    mesh = cast(VirtualMesh, world.robots["r1"].mesh)
    topology = mesh.look(lambda overlays, now: overlays.topology(now))
    return watched.pace(CHOSEN), topology.hub.robot if topology.hub is not None else "r0"


def overlays_of(run: VirtualRun, robot: str) -> Overlays:
    """Return the client of the overlays on the bus of a robot."""
    world = run.world
    return Overlays(VirtualBus(world.robots[robot].router), robot, "bench", now=lambda: world.time.now, prefix=robot)


def transfer(graph: str, seconds: float, seed: int, size: int) -> tuple[float, float, float]:
    """Return s an iteration in quiet and while r1 sends r2 a large message, and s that the message takes."""
    watched = Watched(graph, seconds, seed, "--links", "auto")
    world = watched.run.world
    r1, r2 = (overlays_of(watched.run, name) for name in ("r1", "r2"))
    moments: list[float] = []
    payload = bytes(size)
    r2.on_message(lambda sender, data: moments.append(world.time.now))

    def send() -> None:
        moments.append(world.time.now)
        r1.send("r2", payload, timeout=seconds)

    world.time.at(2.0 * SETTLED, send)
    watched.run.go()
    began, *arrived = moments
    ended = arrived[0] if arrived else math.inf
    return watched.pace(SETTLED, began), watched.pace(began, ended), ended - began
