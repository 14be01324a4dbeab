"""Lateness of the 100 Hz loop, quiet and under everything that happens on a robot, beside `cyclictest` in the same run.

Each load is measured between quiet times, and each time beside cyclictest (package rt-tests) at the same priority.
Judged is the 99th percentile, paired, as the median over repeats: on a shared machine single outliers of tens of ms
meet cyclictest, too, so maxima are told, not judged. The robot balances through all of it.

A loop whose process also handles the bus's messages, as in the thesis, is measured in turns with one beside which
another process handles the same messages in the same way: both meet the same minutes of a shared machine, and the
median of the turns' ratios counts.
"""

import contextlib
import itertools
import math
import os
import re
import shutil
import signal
import statistics
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

from bench.balancer.world import World
from bench.costs.cpu import cpu_s
from bench.rigs.running import lasting, robots_folder
from bench.rows import Row
from services.balancer.realtime import PRIORITY
from sim.processes import footprint
from sim.processes.processes import Child, Processes
from swarm import clock
from swarm.bus.zenoh_bus import Bus
from swarm.core.percentile import percentile
from swarm.errors import LocalError
from swarm.messages import BalancerState
from swarm.messages.codec import decode

PERIOD_S = 0.01
START_S = 120.0
"""s after which a robot that does not balance is given up."""

SETTLE_S = 0.5
"""s after a load began that do not count: what starting its processes costs is not its own."""

RESTARTS_HZ = 100 / 60
QUIET = "quiet"
RESTARTS = "100 restarts in a minute"
BESIDE_QUIET = 1.2
IN_PROCESS = {"flood": 1.0, "hog": BESIDE_QUIET}
"""Loads under which the variant with everything in one process is measured, too, and the goal of ours beside it. Under
a flood of messages ours must be less late. A busy loop sends none, so both are alike then."""

BEYOND_CYCLICTEST_S = 1e-3
RMS_FLOOR = math.radians(0.1)
"""rad; dry friction may hold a quiet robot quite still."""

TICK_LIMIT_S = 1e-3
"""CPU time of a tick with all it does, the simulated body included, of its 10 ms."""

MEMORY_LIMIT_MIB = 30.0
BLOB = 900_000
"""Bytes, nearly the most that one message may have. It takes twelve seconds, so the load lasts beyond its phase."""
BLOB_KEY = "swarm/r0/app/bench/blob"
TRANSFER_S = 60.0
"""s after which a transfer that has not arrived is given up."""

CONFIG = """network = "bench"
[topology]
edges = [["r0", "r1"]]
[mesh]
insecure = true
[dwm]
source = "balancer"
[[relay]]
keys = "swarm/{{self}}/app/*/blob"
overlay = "neighbours"
priority = "bulk"
queue = "all"
[[robots]]
name = "r0"
link = "sim:{home}/r0/mesh.sock"
[[robots]]
name = "r1"
link = "sim:{home}/r1/mesh.sock"
"""


@dataclass(frozen=True)
class Sizes:
    """How much the area measures."""

    repeats: int = 5
    phase_s: float = 6.0
    """Of each load. With 3000 ticks of all repeats, thirty lie above the 99th percentile."""

    stand_s: float = 4.0
    """Until a robot that has begun to balance does so quietly."""

    restart_s: float = 60.0
    """In which services are killed and started again."""

    turns: int = 9
    turn_s: float = 12.0
    """Of each load in each turn of ours and its rival: with 1200 ticks, twelve lie above the 99th percentile."""


FULL = Sizes()
SMOKE = Sizes(1, 1.0, 1.0, 1.0, 1, 1.0)


@dataclass
class Phase:
    """One load, or none, for a few seconds."""

    load: str
    began: float
    ended: float
    cyclictest: list[float]
    """Lateness of each of its wake-ups, s."""
    ticks: list[float] = field(default_factory=list)
    """Of the loop, s."""
    tilts: list[float] = field(default_factory=list)
    """True ones, rad."""


class Robot:
    """r0 with its balancer, bus, mesh and dwm, and r1's bus and mesh at the other end of a link. A context."""

    def __init__(self, *, in_process: bool = False) -> None:
        self._stack = contextlib.ExitStack()
        self.home = Path(self._stack.enter_context(robots_folder()))
        (self.home / "swarm.toml").write_text(CONFIG.format(home=self.home))
        self.ticks = self.home / "ticks"
        self.world = World(self.home)
        self._stack.callback(self.world.close)
        environment = {"SWARM_CONFIG": str(self.home / "swarm.toml"), "SWARM_SIM_LINK": "latency=0.03,bandwidth=78000"}
        self._processes = Processes(environment)
        self._stack.callback(self._processes.stop)
        for name in ("r0", "r1"):
            (self.home / name).mkdir()
            for service in ("bus", "mesh", *(("dwm",) if name == "r0" else ())):
                self._processes.add(name, service, [f"services.{service}"], self.home / name)
        variant = ["--in-process"] if in_process else []
        self._processes.add("r0", "balancer", ["bench.balancer.body", str(self.ticks), *variant], self.home / "r0")
        self._processes.add("r0", "app/consensus", ["services.apps", "consensus"], self.home / "r0")
        self.bus = self._stack.enter_context(Bus.of(self.home / "r0"))

    def __enter__(self) -> "Robot":
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def stand(self, seconds: float) -> None:
        """Wait until it balances, and so long beyond that."""
        began = threading.Event()

        def told(key: str, payload: bytes) -> None:
            if decode(BalancerState, payload, key).mode == "balancing":
                began.set()

        subscription = self.bus.subscribe("swarm/r0/balancer/state", told)
        if not began.wait(START_S):
            raise LocalError(f"bench balancer: the robot does not balance within {START_S:g} s")
        subscription.close()
        time.sleep(seconds)

    def child(self, service: str) -> Child:
        """One of r0's services."""
        return next(child for child in self._processes.of("r0") if child.service == service)

    def load(self, name: str) -> contextlib.AbstractContextManager[subprocess.Popen[bytes]]:
        """A load, in a process of its own."""
        environment = {**os.environ, "SWARM_RUNTIME": str(self.home / "r0"), "SWARM_PARENT": str(os.getpid())}
        return lasting([sys.executable, "-m", "bench.rigs.loads", name], env=environment)

    def restart(self, service: str, pause_s: float = 0.0) -> None:
        """Kill a service and start it again."""
        child = self.child(service)
        if child.process is not None:
            child.process.kill()
            child.process.wait()
        time.sleep(pause_s)
        child.start()

    def end(self) -> None:
        """End the balancer, which then writes down its ticks."""
        process = self.child("balancer").process
        assert process is not None
        process.terminate()
        process.wait(10.0)


def _flood(robot: Robot, seconds: float) -> None:
    with robot.load("flood"), robot.load("listen"):
        time.sleep(seconds)


def _stopped(robot: Robot, seconds: float) -> None:
    with robot.load("flood"), robot.load("listen") as listener:
        time.sleep(1.0)
        listener.send_signal(signal.SIGSTOP)
        time.sleep(seconds - 1.0)


def _router(robot: Robot, seconds: float) -> None:
    for _ in range(int(seconds)):
        robot.restart("bus", pause_s=0.5)
        time.sleep(0.5)


def _hog(robot: Robot, seconds: float) -> None:
    with contextlib.ExitStack() as stack:
        for _ in range(os.cpu_count() or 1):
            stack.enter_context(robot.load("hog"))
        time.sleep(seconds)


def _transfer(robot: Robot, seconds: float) -> None:
    arrived = threading.Event()
    with Bus.of(robot.home / "r1") as other:
        other.subscribe(BLOB_KEY, lambda _key, _payload: arrived.set())
        ends = clock.now() + seconds
        robot.bus.publish(BLOB_KEY, bytes(BLOB))
        if not arrived.wait(TRANSFER_S):
            raise LocalError(f"bench balancer: {BLOB} bytes did not reach r1 within {TRANSFER_S:g} s")
        time.sleep(max(0.0, ends - clock.now()))


def _restarts(robot: Robot, seconds: float) -> None:
    services = itertools.cycle(("mesh", "dwm", "app/consensus", "bus"))
    count = max(1, round(RESTARTS_HZ * (seconds - SETTLE_S)))
    for number in range(count):
        began = clock.now()
        robot.restart(next(services))
        time.sleep(max(0.0, seconds / count - (clock.now() - began)) if number < count - 1 else 0.0)


LOADS: dict[str, Callable[[Robot, float], None]] = {
    "flood": _flood,
    "stopped subscriber": _stopped,
    "mesh transfer": _transfer,
    "hog": _hog,
    "router killed": _router,
    RESTARTS: _restarts,
}
"""In the order of measuring: those that kill services are last, since what is published right behind them is lost."""
SHORT = tuple(load for load in LOADS if load != RESTARTS)


def rows(sizes: Sizes = FULL) -> Iterator[Row]:
    """Measure; yields rows as they are there."""
    if shutil.which("cyclictest") is None:
        raise LocalError("bench balancer needs cyclictest: apt-get install rt-tests")
    phases: list[Phase] = []
    for repeat in range(sizes.repeats):
        with Robot() as robot:
            robot.stand(sizes.stand_s)
            began_cpu, began = _cpu(robot), clock.now()
            found = [phase for load in SHORT for phase in _pair(robot, load, sizes)]
            if repeat == sizes.repeats - 1:
                found += _pair(robot, RESTARTS, sizes)
                cpu = (_cpu(robot) - began_cpu) / ((clock.now() - began) / PERIOD_S)
                memory = footprint.proportional_mib(robot.child("balancer"))
                yield Row("CPU of a tick, loop and simulated body", cpu, "s", TICK_LIMIT_S, 1.0)
                yield Row("loop and bridge, proportional memory", memory, "MiB", MEMORY_LIMIT_MIB, 1.0)
            phases += _ended(robot, found)
            yield Row(f"falls and faults, run {repeat + 1}", robot.world.falls, "", 1.0, 0.0)
    yield from _judge(phases)
    yield from _beside_one_process(sizes)


def _beside_one_process(sizes: Sizes) -> Iterator[Row]:
    """Ours and the variant with everything in one process by turns."""
    found: dict[str, list[tuple[float, float]]] = {load: [] for load in IN_PROCESS}
    for _ in range(sizes.turns):
        ours, rival = (_turn(sizes, in_process=in_process) for in_process in (False, True))
        for load, pairs in found.items():
            pairs.append((ours[load], rival[load]))
    for load, pairs in found.items():
        ours_s, rival_s = (_median(list(each)) for each in zip(*pairs, strict=True))
        yield Row(f"p99, {load}, messages handled beside the loop's process or in it", ours_s, "s", rival_s, None)
        ratios = [ours / theirs for ours, theirs in pairs]
        yield Row(f"the same, median of {sizes.turns} turns' ratios", _median(ratios), "", 1.0, IN_PROCESS[load])
        yield Row("the same, turns in which it is not below 1", sum(ratio >= 1.0 for ratio in ratios), "", 1.0, None)


def _turn(sizes: Sizes, *, in_process: bool) -> dict[str, float]:
    """99th percentile of a robot's lateness by load, s."""
    with Robot(in_process=in_process) as robot:
        with contextlib.nullcontext() if in_process else robot.load("handle"):
            robot.stand(sizes.stand_s)
            found = [_loaded(robot, load, sizes.turn_s) for load in IN_PROCESS]
        return {phase.load: percentile(phase.ticks, 99) for phase in _ended(robot, found)}


def _judge(phases: list[Phase]) -> Iterator[Row]:
    quiet = [phase for phase in phases if phase.load == QUIET]
    yield from _figures(QUIET, quiet)
    for load in dict.fromkeys(phase.load for phase in phases if phase.load != QUIET):
        # The quiet time of a pair is the one right before.
        pairs = [(before, phase) for before, phase in itertools.pairwise(phases) if phase.load == load]
        before, loaded = ([pair[side] for pair in pairs] for side in (0, 1))
        yield from _figures(load, loaded)
        p99 = percentile(_ticks(loaded), 99)
        yield Row(f"{load}: p99 beside quiet, paired", p99, "s", percentile(_ticks(before), 99), BESIDE_QUIET)
        beyond = p99 - percentile(_cyclictests(loaded), 99)
        yield Row(f"{load}: p99 beyond cyclictest's", beyond, "s", BEYOND_CYCLICTEST_S, 1.0)
    tilt = _rms([phase for phase in phases if phase.load != QUIET])
    yield Row("rms tilt under all loads beside quiet", tilt, "rad", max(RMS_FLOOR, _rms(quiet)), BESIDE_QUIET)


def _figures(load: str, phases: list[Phase]) -> Iterator[Row]:
    """Told, not judged: beside cyclictest's of the same times."""
    ticks, rival = _ticks(phases), _cyclictests(phases)
    for name, percent in (("p50", 50.0), ("p99", 99.0), ("p99.9", 99.9), ("max", 100.0)):
        yield Row(
            f"{load}: {name} beside cyclictest", percentile(ticks, percent), "s", percentile(rival, percent), None
        )


def _pair(robot: Robot, load: str, sizes: Sizes) -> list[Phase]:
    """A quiet time and one as long under load."""
    seconds = sizes.restart_s if load == RESTARTS else sizes.phase_s
    quiet = _phase(QUIET, seconds, lambda: time.sleep(seconds + SETTLE_S))
    return [quiet, _loaded(robot, load, seconds)]


def _loaded(robot: Robot, load: str, seconds: float) -> Phase:
    return _phase(load, seconds, lambda: LOADS[load](robot, seconds + SETTLE_S))


def _phase(name: str, seconds: float, act: Callable[[], None]) -> Phase:
    with ThreadPoolExecutor(1) as threads:
        acting = threads.submit(act)
        time.sleep(SETTLE_S)
        began = clock.now()
        late = _cyclictest(seconds)
        ended = clock.now()
        acting.result()
    return Phase(name, began, ended, late)


def _cyclictest(seconds: float) -> list[float]:
    """Lateness of a C thread at the loop's priority and period, s."""
    timing = [f"--priority={PRIORITY}", f"--interval={PERIOD_S * 1e6:.0f}", f"--loops={seconds / PERIOD_S:.0f}"]
    command = ["cyclictest", "--quiet", "--mlockall", "--threads=1", "--policy=fifo", *timing, "--histogram=100000"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    late: list[float] = []
    for line in done.stdout.splitlines():
        if (match := re.fullmatch(r"(\d+)\s+(\d+)", line.strip())) is not None:
            late += [int(match[1]) * 1e-6] * int(match[2])
    if not late:
        raise LocalError(f"cyclictest gave no histogram: {done.stdout[-200:]}")
    return late


def _cpu(robot: Robot) -> float:
    process = robot.child("balancer").process
    assert process is not None
    return cpu_s(process.pid)


def _ended(robot: Robot, phases: list[Phase]) -> list[Phase]:
    """The phases of a run, with the loop's ticks and the body's tilt in them."""
    robot.end()
    ticks = list(struct.iter_unpack("dd", robot.ticks.read_bytes()))
    for phase in phases:
        phase.ticks = [late for at, late in ticks if phase.began <= at <= phase.ended]
        phase.tilts = [tilt for at, tilt in robot.world.tilts if phase.began <= at <= phase.ended]
        if not phase.ticks or not phase.tilts:
            raise LocalError(f"bench balancer: no ticks or no poses under {phase.load}: did the balancer end?")
    return phases


def _ticks(phases: list[Phase]) -> list[float]:
    """Lateness of all ticks of the loop, s."""
    return [late for phase in phases for late in phase.ticks]


def _cyclictests(phases: list[Phase]) -> list[float]:
    """Lateness of all wake-ups of cyclictest, s."""
    return [late for phase in phases for late in phase.cyclictest]


def _median(values: list[float]) -> float:
    return statistics.median(values)


def _rms(phases: list[Phase]) -> float:
    """rad, of the true tilt around where the robot stands."""
    return math.sqrt(statistics.fmean(statistics.pvariance(phase.tilts) for phase in phases))
