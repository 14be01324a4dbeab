"""Faults in mid-run: the same trajectory bit for bit, and what they cost in time.

First one service of one robot is killed or stopped. Then faults of all kinds are mixed in one schedule that is drawn
from a seed, against six robots of real processes over links that lose 2 % of their packets; they come at random
moments, often several at a time. Faults that take a robot's memory away (a power cut) are in
`bench.faults.random_faults`.
"""

import math
import random
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from bench.faults.player import BACK_WITHIN_S, Player
from bench.rigs.simulation import Simulation
from bench.rows import Row
from sim.virtual.run import run_virtually
from swarm import clock
from swarm.core.graph import Graph
from swarm.recording.trajectory import Trajectory

NAMES = ("r0", "r1", "r2")
VICTIM = "r1"
"""The middle one of a line: both others depend on it."""

LONGEST_PAUSE_S = 3.0
"""Budget for the longest gap between two iterations: a link that dies without a word is noticed after 3 s."""

APP_FILE = Path(__file__).parents[1] / "rigs/lattice.py"
APP = APP_FILE.stem
SERVICES = ("bus", "mesh", "dwm", "balancer", f"app/{APP}")
LOSS = "2%"
SIGNALS = ("KILL", "TERM", "STOP")
SERVICE, LINK, ROBOT, EVERYWHERE = "a service", "a link", "a whole robot", "a service of all robots"
TARGETS = (*3 * (SERVICE,), *2 * (LINK,), ROBOT, EVERYWHERE)
STOP_S = (0.05, 10.0)
"""Of a stop; its logarithm is drawn evenly, so that short ones are as frequent as long ones."""

CUT_S = (0.2, 5.0)
PAUSE_S = (0.05, 0.7)
"""Between two faults."""

WARM_UP = 30
"""Iterations of all robots before the first fault."""

GO_ON = 60
"""All robots are back when each has done so many iterations more."""


@dataclass(frozen=True)
class Sizes:
    """How much the area does."""

    count: int = 1000
    """Faults of the mixed schedule."""

    seed: int = 1
    robots: int = 6
    """Of the mixed schedule, in a loop."""

    services: tuple[str, ...] = ("bus", "mesh", "dwm", "balancer", "app")
    """Each is killed once in a run of its own."""

    iterations: int = 200
    fault_at: int = 60
    stop_s: float = 2.0


FULL = Sizes()
SMOKE = Sizes(6, 1, 3, ("mesh",), 150, 10, 0.5)


def rows(sizes: Sizes = FULL) -> Iterator[Row]:
    """Run one fault at a time, then the mixed schedule."""
    yield from _single(sizes)
    yield from _mixed(sizes)


def _single(sizes: Sizes) -> Iterator[Row]:
    """Run once undisturbed, then once for each fault."""
    with Simulation(*_line(sizes)) as simulation:
        simulation.finish()
        undisturbed = {name: simulation.trajectory(name) for name in NAMES}
    yield Row("undisturbed, longest pause", longest_pause(undisturbed), "s", LONGEST_PAUSE_S, 1.0)
    for service in sizes.services:
        paths = _disturbed(sizes, service)
        yield Row(f"{service} killed, values that differ", _differing(undisturbed, paths), "", 1.0, 0.0)
        yield Row(f"{service} killed, longest pause", longest_pause(paths), "s", LONGEST_PAUSE_S, 1.0)
    paths = _disturbed(sizes, "app", stop=True)
    yield Row(f"app stopped {sizes.stop_s:g} s, values that differ", _differing(undisturbed, paths), "", 1.0, 0.0)
    beyond = longest_pause(paths) - sizes.stop_s
    yield Row(f"app stopped {sizes.stop_s:g} s, pause beyond that", beyond, "s", LONGEST_PAUSE_S, 1.0)


def _line(sizes: Sizes) -> tuple[str, ...]:
    return "consensus", "--robots", "3", "--iterations", str(sizes.iterations)


def _disturbed(sizes: Sizes, service: str, *, stop: bool = False) -> dict[str, Trajectory]:
    """A run in which one service of the victim is killed (or stopped for a while) in the middle."""
    with Simulation(*_line(sizes)) as simulation:
        simulation.wait_for(VICTIM, sizes.fault_at)
        if stop:
            simulation.kill(VICTIM, service, "STOP")
            time.sleep(sizes.stop_s)
            simulation.kill(VICTIM, service, "CONT")
        else:
            simulation.kill(VICTIM, service)
        simulation.finish()
        return {name: simulation.trajectory(name) for name in NAMES}


def _differing(expected: Mapping[str, Trajectory], found: Mapping[str, Trajectory]) -> float:
    """How many values of all robots and iterations are not equal to the bit; nan for a run that stopped short."""
    if any(path.last != expected[name].last for name, path in found.items()):
        return math.nan
    return float(sum(path.rows[k] != found[name].rows.get(k) for name, path in expected.items() for k in path.rows))


def longest_pause(paths: Mapping[str, Trajectory]) -> float:
    """The longest time any robot spent in one iteration, s."""
    return max(at - path.times[k - 1] for path in paths.values() for k, at in path.times.items() if k - 1 in path.times)


def _mixed(sizes: Sizes) -> Iterator[Row]:
    """Play the schedule, then compare with the same swarm in virtual time, where nothing disturbs it."""
    names = tuple(f"r{index}" for index in range(sizes.robots))
    swarm = (str(APP_FILE), "--robots", str(sizes.robots), "--topology", "loop", "--seed", str(sizes.seed))
    with Simulation(*swarm, "--loss", LOSS, "--seconds", "100000") as simulation:
        for name in names:
            simulation.wait_for(name, WARM_UP, APP)
        began, first = clock.now(), _reached(simulation, names)
        played = Schedule(Player(simulation, names, APP), names, random.Random(sizes.seed)).play(sizes.count)
        ended, reached = clock.now(), _reached(simulation, names)
        for name in names:
            simulation.wait_for(name, max(reached.values()) + GO_ON, APP, BACK_WITHIN_S)
        back = clock.now()
        simulation.stop()
        paths = {name: simulation.trajectory(name, APP) for name in names}
    last = max(path.last for path in paths.values())
    undisturbed = run_virtually(*swarm, "--iterations", str(last), rows=True)[1].trajectories
    compared = [(path.rows[k], undisturbed[name].rows[k]) for name, path in paths.items() for k in path.rows]
    missing = sum(k not in path.rows for path in paths.values() for k in range(path.last + 1))
    yield Row(f"faults played, seed {sizes.seed}", float(played.total()), "", float(sizes.count), None)
    for kind, count in sorted(played.items()):
        yield Row(f"of these, {kind}", float(count), "", float(played.total()), None)
    yield Row("values compared", float(len(compared)), "", float(len(names) * (last + 1)), None)
    yield Row("values that differ", float(sum(found != right for found, right in compared)), "", 1.0, 0.0)
    yield Row("values that are missing", float(missing), "", 1.0, 0.0)
    pace = (min(reached.values()) - min(first.values())) / (ended - began)
    yield Row("iterations a second among faults", pace, "1/s", 1.0, None)
    yield Row("longest pause", longest_pause(paths), "s", LONGEST_PAUSE_S, None)
    yield Row(f"from the last fault until all have done {GO_ON} more", back - ended, "s", BACK_WITHIN_S, 1.0)


def _reached(simulation: Simulation, names: Sequence[str]) -> dict[str, int]:
    return {name: simulation.trajectory(name, APP).last for name in names}


class Schedule:
    """Draws faults and has them played."""

    def __init__(self, player: Player, names: Sequence[str], draw: random.Random) -> None:
        """`names` are those of the robots, in a loop."""
        self._player, self._names, self._draw = player, names, draw
        self._edges = Graph.of_shape("loop", tuple(names)).edges

    def play(self, count: int) -> Counter[str]:
        """Play `count` faults; return how many of each kind. A fault that finds nothing to spoil does not count. The
        last stops end with the schedule."""
        played: Counter[str] = Counter()
        while played.total() < count:
            self._player.pause(self._draw.uniform(*PAUSE_S))
            kind, fault = self._next()
            if fault():
                played[kind] += 1
        self._player.finish()
        return played

    def _next(self) -> tuple[str, Callable[[], int]]:
        """The next fault's kind, and what plays it. As many numbers are drawn whatever it is."""
        player, draw = self._player, self._draw
        target, name = draw.choice(TARGETS), draw.choice(SIGNALS)
        robot, service, (one, other) = draw.choice(self._names), draw.choice(SERVICES), draw.choice(self._edges)
        both, turned = draw.random() < 0.5, draw.random() < 0.5
        cut_s, stop_s = draw.uniform(*CUT_S), math.exp(draw.uniform(*map(math.log, STOP_S)))
        if target == LINK:
            ends = (other, one) if turned else (one, other)
            return f"cut, {'both ways' if both else 'one way'}", lambda: player.cut(*ends, cut_s, both=both)
        robots = self._names if target == EVERYWHERE else (robot,)
        victims = [(each, of) for each in robots for of in (SERVICES if target == ROBOT else (service,))]
        if name == "STOP":
            return f"{name}, {target}", lambda: sum(player.stop(*victim, stop_s) for victim in victims)
        return f"{name}, {target}", lambda: sum(player.kill(*victim, name) for victim in victims)
