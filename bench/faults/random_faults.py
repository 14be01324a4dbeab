"""Random faults against a simulated swarm of real processes: what becomes of services, values and recordings.

Faults come at random moments to random robots, often several at once: `kill` (SIGKILL), `restart` (SIGTERM, as
systemctl does), `stop` (SIGSTOP for a while), `cut` (a link, both ways); in the second half of the run also `reboot`
(all of a robot's processes end at once, and what was in memory is gone), whose robot comes back by a new epoch. The
app's values never settle and are computed once more from the thesis' rule alone (restless_rule.py): every recorded
value must be equal to these to the bit.
"""

import contextlib
import math
import random
import statistics
import sys
import time
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

from bench.faults import restless_rule
from bench.faults.player import BACK_WITHIN_S, Player
from bench.rigs.simulation import Simulation
from bench.rows import Row
from sim.control import power_switch
from swarm import clock
from swarm.core.graph import Graph
from swarm.process.simulations import pid_file
from swarm.recording.reader import SUFFIX
from swarm.recording.trajectory import Trajectory

APP = "restless"
APP_FILE = Path(__file__).with_name("restless.py")
NAMES = tuple(f"r{index}" for index in range(6))
EDGES = tuple((NAMES[i], NAMES[(i + 1) % 6]) for i in range(6))
GRAPH = Graph(NAMES, EDGES)
STARTS = {name: index * 0.1 for index, name in enumerate(NAMES)}
SERVICES = ("bus", "mesh", "dwm", "balancer", f"app/{APP}")
KINDS = ("kill", "restart", "stop", "cut")
REBOOT = "reboot"
REBOOTS = 0.1
"""Share of them among the faults of the second half: each costs all robots some seconds, in which nothing is done that
other faults could spoil."""
OFF_S = (1.0, 4.0)
"""How long a robot that reboots is away."""
DROP_AFTER_S = 30.0
"""Longer than any fault lasts: members change for a reboot alone, of which a robot tells when it is back."""

PAUSE_S = (0.1, 1.5)
"""Between two faults."""
LENGTH_S = (0.2, 2.5)
"""Of a stop or a cut."""
WARM_UP = 40
"""Iterations of all robots before the first fault, and until one has gone on."""

LONGEST_PAUSE_S = 8.0
"""Budget: a link that is lost without a word (3 s) behind the longest stop, and the way back."""
REBOOT_PAUSE_S = 20.0
"""What one reboot with nothing else costs at most: the longest one, a start (5 s), links, a ballot, and one more for
robots that it has missed. Told only: where other faults and reboots go on meanwhile, it takes as long as they do."""
MEMORY_GROWTH = 1.2
DESCRIPTORS_GROWTH = 2.0
LOST_S = 1.0
UNKNOWN = 0.01
"""Share of the values whose neighbours' were lost in a reboot."""


@dataclass(frozen=True)
class Sizes:
    """How much the area does."""

    count: int = 1000
    """Faults, the second half with reboots."""

    seed: int = 1


FULL = Sizes()
SMOKE = Sizes(6)


@dataclass
class Use:
    """Of one process."""

    memory_kib: int
    descriptors: int


@dataclass
class Done:
    """What was done to the swarm."""

    count: int = 0
    reboots: Counter[str] = field(default_factory=Counter)
    """By robot."""


def rows(sizes: Sizes = FULL) -> Iterator[Row]:
    """Run the faults, then compare."""
    count, seed = sizes.count, sizes.seed
    phases = [part for index, name in enumerate(NAMES) for part in ("--set", f"{name}.phase={index}")]
    starts = [part for name, value in STARTS.items() for part in ("--set", f"{name}.value={value}")]
    command = (str(APP_FILE), "--robots", "6", "--topology", "loop", "--seconds", "100000", *phases, *starts)
    draw, done = random.Random(seed), Done()
    with Simulation(*command, "--absent", "drop", "--drop-after", str(DROP_AFTER_S)) as simulation:
        for name in NAMES:
            simulation.wait_for(name, WARM_UP, APP)
        before = _use(simulation)
        _faults(simulation, draw, done, count // 2, reboots=0.0)
        _wait_for_all(simulation)
        members_changed = [n for n in NAMES if len(restless_rule.read({n: [_path(simulation, n)]}, GRAPH)) > 1]
        halfway = clock.now()
        _faults(simulation, draw, done, count, reboots=REBOOTS)
        _wait_for_all(simulation)
        after = _use(simulation)
        simulation.stop()
        epochs = restless_rule.read({name: [_path(simulation, name)] for name in NAMES}, GRAPH)
        paths = {name: simulation.trajectory(name, APP) for name in NAMES}
    newest = list(epochs.values())[-1]
    found = restless_rule.compare(epochs, STARTS)
    for text in found.wrong[:10]:
        sys.stderr.write(f"{text}\n")
    iterations = sum(
        max((k for s in epoch.states.values() for k in s), default=0) - epoch.first for epoch in epochs.values()
    )
    yield Row(f"random faults, seed {seed}", float(done.count), "", float(count), None)
    yield Row("reboots among them", float(done.reboots.total()), "", 1.0, None)
    yield Row("iterations of all robots in it", float(iterations), "", 1.0, None)
    yield Row("epochs in the half without reboots", float(len(members_changed)), "", 1.0, 0.0)
    yield Row("epochs", float(newest.counter), "", float(max(done.reboots.total(), 1)), None)
    yield Row("robots that are no members in the end", float(len(NAMES) - len(newest.graph.names)), "", 1.0, 0.0)
    yield Row("values that differ from the rule's", float(len(found.wrong)), "", 1.0, 0.0)
    yield Row("values that nothing can be compared with", float(found.unknown), "", float(found.compared), UNKNOWN)
    more = sum((found.anew - done.reboots).values())
    yield Row("starts anew that no reboot explains", float(more), "", 1.0, 0.0)
    pauses = [_longest_pause(paths, 0.0, halfway), _longest_pause(paths, halfway, math.inf)]
    yield Row("longest pause", pauses[0], "s", LONGEST_PAUSE_S, 1.0)
    yield Row("longest pause with reboots", pauses[1], "s", REBOOT_PAUSE_S, None)
    period = statistics.median(b - a for path in paths.values() for a, b in pairwise(sorted(path.times.values())))
    yield Row("longest piece missing in a recording", restless_rule.lost(epochs) * period, "s", LOST_S, 1.0)
    growth = max(after[key].descriptors - before[key].descriptors for key in before)
    yield Row("descriptors more than before, worst process", float(growth), "", DESCRIPTORS_GROWTH, 1.0)
    grown = statistics.fmean(after[key].memory_kib / before[key].memory_kib for key in before)
    yield Row("memory beside before, mean of all processes", grown, "", MEMORY_GROWTH, 1.0)


def _wait_for_all(simulation: Simulation) -> None:
    """Until all robots have gone on, and all their services are at work."""
    reached = {name: simulation.trajectory(name, APP).last for name in NAMES}
    for name in NAMES:
        simulation.wait_for(name, reached[name] + WARM_UP, APP, BACK_WITHIN_S)
    _wait_for_all_services(simulation)


def _faults(simulation: Simulation, draw: random.Random, done: Done, until: int, *, reboots: float) -> None:
    """Do them, up to the number `until` (a process may just be away)."""
    player, away = Player(simulation, NAMES, APP), dict[str, float]()
    while done.count < until:
        player.pause(draw.uniform(*PAUSE_S))
        now = time.monotonic()
        kind = REBOOT if draw.random() < reboots else draw.choice(KINDS)
        robot, service = draw.choice(NAMES), draw.choice(SERVICES)
        if kind == REBOOT:
            if now >= away.get(robot, 0.0):
                off = draw.uniform(*OFF_S)
                power_switch.reboot(simulation.run_dir, robot, off)
                away[robot] = now + off
                player.forget(robot)
                done.reboots[robot] += 1
                done.count += 1
        elif now < away.get(robot, 0.0):
            continue  # nothing is there to be spoilt
        elif kind == "cut":
            done.count += player.cut(*draw.choice(EDGES), draw.uniform(*LENGTH_S))
        elif kind == "stop":
            done.count += player.stop(robot, service, draw.uniform(*LENGTH_S))
        else:
            done.count += player.kill(robot, service, "KILL" if kind == "kill" else "TERM")
    player.finish()


def _wait_for_all_services(simulation: Simulation) -> None:
    """Until all run, and none has been started within the last 3 s: their memory is that of a service at work then."""
    end = time.monotonic() + BACK_WITHIN_S
    files = [pid_file(simulation.run_dir, robot, service) for robot in NAMES for service in SERVICES]
    while time.monotonic() < end:
        if all(map(_at_work, files)):
            return
        time.sleep(0.1)


def _at_work(file: Path) -> bool:
    """Whether the process whose pid stands in a file was started 3 s ago and has memory: one that was killed has none,
    and while its robot is off there is no file."""
    with contextlib.suppress(OSError):
        status = Path(f"/proc/{file.read_text().strip()}/status").read_text()
        return "VmRSS:" in status and time.time() - file.stat().st_mtime > 3.0
    return False


def _use(simulation: Simulation) -> dict[tuple[str, str], Use]:
    found = {("", "simulation"): _of(simulation.process.pid)}
    for robot in NAMES:
        for service in SERVICES:
            found[robot, service] = _of(int(pid_file(simulation.run_dir, robot, service).read_text()))
    return found


def _of(pid: int) -> Use:
    status = Path(f"/proc/{pid}/status").read_text()
    return Use(int(status.split("VmRSS:")[1].split()[0]), len(list(Path(f"/proc/{pid}/fd").iterdir())))


def _longest_pause(paths: Mapping[str, Trajectory], since: float, until: float) -> float:
    """The longest time between two values of a robot that follow each other, begun in [since, until), s."""
    return max(
        at - path.times[k - 1]
        for path in paths.values()
        for k, at in path.times.items()
        if k > 1 and k - 1 in path.times and since <= path.times[k - 1] < until
    )


def _path(simulation: Simulation, name: str) -> Path:
    return simulation.records / f"{name}.{APP}{SUFFIX}"
