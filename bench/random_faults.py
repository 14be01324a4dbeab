"""Random faults against a simulated swarm of real processes: what becomes of services, values and recordings.

Faults come at random moments to random robots, often several at once: `kill` (SIGKILL), `restart` (SIGTERM, as
systemctl does), `stop` (SIGSTOP for a while), `cut` (a link, both ways). The app's values never settle and are computed
once more here, from the thesis' rule alone: every recorded value must be equal to these to the bit.
"""

import math
import os
import random
import signal
import statistics
import time
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

from bench.restless import TURN
from bench.rows import Row
from bench.simulation import Simulation
from swarm.air import silence
from swarm.core.graph import Graph
from swarm.recording.trajectory import Trajectory
from swarm.simulations import pid_file

APP = "restless"
APP_FILE = Path(__file__).with_name("restless.py")
NAMES = tuple(f"r{index}" for index in range(6))
EDGES = tuple((NAMES[i], NAMES[(i + 1) % 6]) for i in range(6))
SERVICES = ("bus", "mesh", "dwm", "balancer", f"app/{APP}")
KINDS = ("kill", "restart", "stop", "cut")

PAUSE_S = (0.1, 1.5)
"""Between two faults."""
LENGTH_S = (0.2, 2.5)
"""Of a stop or a cut."""
WARM_UP = 40
START_S = 300.0
"""Until all robots have done so many iterations, on a machine that others use as well."""
BACK_WITHIN_S = 60.0
"""All robots have gone on by then, after the last fault."""
AT_MOST = 3
AGAIN_S = 11.0
"""A service that ends five times within 10 s is given up, by the simulation as by systemd: none is killed so often."""

LONGEST_PAUSE_S = 8.0
"""Budget: a link that is lost without a word (3 s) behind the longest stop, and the way back."""
MEMORY_GROWTH = 1.2
DESCRIPTORS_GROWTH = 2.0
LOST_S = 1.0


@dataclass
class Use:
    """Of one process."""

    memory_kib: int
    descriptors: int


def rows(count: int, seed: int) -> Iterator[Row]:
    """Run `count` faults drawn from `seed`."""
    phases = [part for index, name in enumerate(NAMES) for part in ("--set", f"{name}.phase={index}")]
    starts = [part for index, name in enumerate(NAMES) for part in ("--set", f"{name}.value={index * 0.1}")]
    command = (str(APP_FILE), "--robots", "6", "--topology", "loop", "--seconds", "100000", *phases, *starts)
    with Simulation(*command) as simulation:
        for name in NAMES:
            simulation.wait_for(name, WARM_UP, APP, START_S)
        before = _use(simulation)
        done = _faults(simulation, random.Random(seed), count)
        reached = {name: simulation.trajectory(name, APP).last for name in NAMES}
        for name in NAMES:
            simulation.wait_for(name, reached[name] + WARM_UP, APP, BACK_WITHIN_S)
        _wait_for_all_services(simulation)
        after = _use(simulation)
        paths = {name: simulation.trajectory(name, APP) for name in NAMES}
    iterations = min(path.last for path in paths.values())
    yield Row(f"random faults, seed {seed}", float(done), "", float(count), None)
    yield Row("iterations of all robots in it", float(iterations), "", 1.0, None)
    yield Row("robots that did not go on", float(sum(path.last < 0 for path in paths.values())), "", 1.0, 0.0)
    yield Row("values that differ from the rule's", float(_differing(paths)), "", 1.0, 0.0)
    yield Row("longest pause", _longest_pause(paths), "s", LONGEST_PAUSE_S, 1.0)
    yield Row("longest piece missing in a recording", _longest_gap(paths), "s", LOST_S, 1.0)
    growth = max(after[key].descriptors - before[key].descriptors for key in before)
    yield Row("descriptors more than before, worst process", float(growth), "", DESCRIPTORS_GROWTH, 1.0)
    grown = statistics.fmean(after[key].memory_kib / before[key].memory_kib for key in before)
    yield Row("memory beside before, mean of all processes", grown, "", MEMORY_GROWTH, 1.0)


def _faults(simulation: Simulation, draw: random.Random, count: int) -> int:
    """Do them; how many were done (a process may just be away)."""
    done, ends = 0, list[tuple[float, str, str]]()
    kills: dict[tuple[str, str], deque[float]] = {}
    while done < count:
        due = time.monotonic() + draw.uniform(*PAUSE_S)
        while (now := time.monotonic()) < due:
            for end in [end for end in ends if end[0] <= now]:
                ends.remove(end)
                _signal(simulation, end[1], end[2], "CONT")
            time.sleep(0.02)
        kind, robot, service = draw.choice(KINDS), draw.choice(NAMES), draw.choice(SERVICES)
        if kind == "cut":
            one, other = draw.choice(EDGES)
            length = draw.uniform(*LENGTH_S)
            done += _cut(simulation, one, other, length)
        elif kind == "stop":
            if not any(end[1:] == (robot, service) for end in ends) and _signal(simulation, robot, service, "STOP"):
                ends.append((now + draw.uniform(*LENGTH_S), robot, service))
                done += 1
        else:
            recent = kills.setdefault((robot, service), deque())
            while recent and recent[0] < now - AGAIN_S:
                recent.popleft()
            stopped = any(end[1:] == (robot, service) for end in ends)
            if len(recent) < AT_MOST and not stopped:
                recent.append(now)
                done += _signal(simulation, robot, service, "KILL" if kind == "kill" else "TERM")
    for _, robot, service in ends:
        _signal(simulation, robot, service, "CONT")
    return done


def _signal(simulation: Simulation, robot: str, service: str, name: str) -> bool:
    """By its pid file, without the second that a command takes to start."""
    try:
        os.kill(int(pid_file(simulation.run_dir, robot, service).read_text()), getattr(signal, f"SIG{name}"))
    except (OSError, ValueError):
        return False
    return True


def _cut(simulation: Simulation, one: str, other: str, seconds: float) -> bool:
    try:
        silence(simulation.run_dir, one, other, seconds)
        silence(simulation.run_dir, other, one, seconds)
    except OSError:
        return False  # a mesh that was killed has no ear at this moment
    return True


def _wait_for_all_services(simulation: Simulation) -> None:
    """Until none has been started within the last 3 s: their memory is that of a service at work then."""
    end = time.monotonic() + BACK_WITHIN_S
    while time.monotonic() < end:
        ages = [time.time() - pid_file(simulation.run_dir, r, s).stat().st_mtime for r in NAMES for s in SERVICES]
        if min(ages) > 3.0:
            return
        time.sleep(0.1)


def _use(simulation: Simulation) -> dict[tuple[str, str], Use]:
    found = {("", "simulation"): _of(simulation.process.pid)}
    for robot in NAMES:
        for service in SERVICES:
            found[robot, service] = _of(int(pid_file(simulation.run_dir, robot, service).read_text()))
    return found


def _of(pid: int) -> Use:
    status = Path(f"/proc/{pid}/status").read_text()
    return Use(int(status.split("VmRSS:")[1].split()[0]), len(list(Path(f"/proc/{pid}/fd").iterdir())))


def _differing(paths: dict[str, Trajectory]) -> int:
    """How many recorded values are not those of the rule, computed here by another few lines."""
    graph = Graph(NAMES, EDGES)
    weights = {name: graph.metropolis_weights(name) for name in NAMES}
    values = {name: index * 0.1 for index, name in enumerate(NAMES)}
    wrong = 0
    for k in range(max(path.last for path in paths.values()) + 1):
        for name, path in paths.items():
            if k in path.rows and path.rows[k][path.columns.index("value")] != repr(values[name]):
                wrong += 1
        values = {
            name: value
            + sum(weights[name][other] * (values[other] - value) for other in sorted(weights[name]))
            for name, value in values.items()
        }  # fmt: skip
        values = {name: values[name] + math.sin(TURN * k + index) for index, name in enumerate(NAMES)}
    return wrong


def _longest_pause(paths: dict[str, Trajectory]) -> float:
    """The longest time between two values of a robot that follow each other, s."""
    return max(
        at - path.times[k - 1]
        for path in paths.values()
        for k, at in path.times.items()
        if k > 1 and k - 1 in path.times
    )


def _longest_gap(paths: dict[str, Trajectory]) -> float:
    """The longest run of iterations that a recording lacks, in s of an undisturbed run."""
    longest = 0.0
    for path in paths.values():
        known = sorted(path.times)
        period = statistics.median(path.times[b] - path.times[a] for a, b in pairwise(known))
        longest = max(longest, *((b - a - 1) * period for a, b in pairwise(known)))
    return longest
