"""Time from a stop to motors off, by each way a stop can take and under all that may be in its way.

Each stop finds r0 standing up or balancing. The truth is the balancer's own: the end of the control step that switched
the motors off (`bench.stop.body`). The clock begins where the stop is given: for the page's button when its command
arrives in the server, for an app when it publishes, and for `swarm estop`, on the robot or by ssh, when the program
gives its stop; what it takes to start that program is told apart.
"""

import contextlib
import fcntl
import math
import os
import statistics
import struct
import subprocess
import sys
import termios
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field

from bench.mesh.transfer import FULL as TRANSFER
from bench.rigs import loads
from bench.rigs.running import lasting
from bench.rows import Row
from bench.stop.estop import NewerStop
from bench.stop.robots import RobotsOnALine
from laptop.cli import halt as halt_ssh
from laptop.view.actions import control
from swarm import clock
from swarm.app.overlays import Overlays
from swarm.errors import LocalError
from swarm.messages import Stop
from swarm.messages.codec import encode
from swarm.messages.keys import STOP

COUNT = 34
"""Stops a cell: 1020 in all."""

TICK_S = 0.01
BEYOND_S = TICK_S + 0.02
"""s by which the longest of a cell's stops may be beyond the quiet median of the same way."""
STATE_S = 0.2
"""s from motors off until `balancer/state` says so."""

QUIET = "quiet"
UNKNOWN = "unknown fields"
FLOOD_HZ = loads.COMMANDS_HZ * loads.COMMANDS_AT_ONCE
FLOOD = f"{FLOOD_HZ:g} commands a second"

FLOOD_SETTLES_S = 1.5
"""s of flood, hog or transfer before the first stop: what waits in queues by then is in its way."""
PIPE_FULL_S = 1.0
"""s without growth after which a pipe is full."""

LOADS = (sys.executable, "-m", loads.__name__)


def _payload(*, newer: bool) -> tuple[float, bytes]:
    """A stop of this or a later release, and when it was made."""
    now = clock.now()
    return now, encode((NewerStop if newer else Stop)(now, "bench", "bench"))


def _by_page(robots: RobotsOnALine, *, newer: bool) -> float:
    began = clock.now()
    with _replaced(control, "Stop", NewerStop) if newer else contextlib.nullcontext():
        robots.page.stop()
    return began


def _by_estop(robots: RobotsOnALine, *, newer: bool) -> None:
    program = "bench.stop.estop" if newer else "laptop.cli"
    command = [sys.executable, "-m", program, "estop", "bench"]
    subprocess.run(command, env=robots.environment("r0"), capture_output=True, check=False)


def _by_hops(robots: RobotsOnALine, *, newer: bool) -> float:
    now, payload = _payload(newer=newer)
    robots.buses["r3"].publish(STOP, payload)
    return now


def _by_ssh(robots: RobotsOnALine, *, newer: bool) -> None:
    robots.program("bench.stop.estop" if newer else "laptop.cli")
    halt_ssh.command((robots.host,), robots.ssh, stop=True, reason="bench", began=clock.elapsed())


def _by_app(robots: RobotsOnALine, *, newer: bool) -> float:
    now, payload = _payload(newer=newer)
    robots.buses["r0"].publish(STOP, payload)
    return now


WAYS: Mapping[str, Callable[..., float | None]] = {
    "page's button": _by_page,
    "swarm estop": _by_estop,
    "over three hops": _by_hops,
    "over ssh": _by_ssh,
    "an app": _by_app,
}


@contextlib.contextmanager
def _replaced(module: object, name: str, value: object) -> Iterator[None]:
    before = getattr(module, name)
    setattr(module, name, value)
    try:
        yield
    finally:
        setattr(module, name, before)


@contextlib.contextmanager
def _hogs(robots: RobotsOnALine) -> Iterator[list[Row]]:
    with contextlib.ExitStack() as stack:
        for _ in range(os.cpu_count() or 1):
            stack.enter_context(lasting([*LOADS, "hog"], env=robots.environment("r0")))
        time.sleep(FLOOD_SETTLES_S)
        yield []


@contextlib.contextmanager
def _flood(robots: RobotsOnALine) -> Iterator[list[Row]]:
    """Its row tells whether there were as many commands as its name says."""
    with lasting([*LOADS, "commands"], env=robots.environment("r0"), stdout=subprocess.PIPE) as process:
        time.sleep(FLOOD_SETTLES_S)
        rows: list[Row] = []
        yield rows
        assert process.stdout is not None
        told = os.read(process.stdout.fileno(), 1 << 16).split()
        reached = float(told[-1]) if told else math.nan
        rows.append(Row(f"{FLOOD}: time between two", 1.0 / reached, "s", 1.0 / FLOOD_HZ, 1.05))


@contextlib.contextmanager
def _transfer(robots: RobotsOnALine) -> Iterator[list[Row]]:
    """A megabyte after the other from r3 to r0, so that one is under way at any time; none is, afterwards."""
    overlays, ended = Overlays(robots.buses["r3"], "r3", "bench"), threading.Event()
    Overlays(robots.buses["r0"], "r0", "bench").on_message(lambda sender, data: None)

    def run() -> int:
        delivered = 0
        while not ended.is_set():
            with contextlib.suppress(LocalError, TimeoutError):
                sent = overlays.send("r0", bytes(TRANSFER.size), timeout=60.0).result(timeout=60.0)
                delivered += sent.delivered
                if not sent.delivered:  # a refusal comes at once
                    ended.wait(1.0)
        return delivered

    with ThreadPoolExecutor(1) as threads:
        transfers = threads.submit(run)
        try:
            time.sleep(FLOOD_SETTLES_S)
            yield []
        finally:
            ended.set()
        if not transfers.result():
            raise LocalError("bench stop: no megabyte reached r0, so none was under way beside the stops")


@contextlib.contextmanager
def _full_pipe(robots: RobotsOnALine) -> Iterator[list[Row]]:
    """The operator's page takes nothing more of what r0 tells it, until the pipe between them is full."""
    with robots.view.lock:
        process = robots.view.buses["r0"]._process
        assert process is not None
        assert process.stdout is not None
        waiting, since = 0, clock.now()
        while not waiting or clock.now() < since + PIPE_FULL_S:
            time.sleep(0.05)
            (now_waiting,) = struct.unpack("i", fcntl.ioctl(process.stdout, termios.FIONREAD, bytes(4)))
            if now_waiting != waiting:
                waiting, since = now_waiting, clock.now()
        yield []
        if process.poll() is not None:
            raise LocalError("bench stop: what fills the page's pipe ended, so there was no full pipe beside the stops")


CONDITIONS: Mapping[str, Callable[[RobotsOnALine], contextlib.AbstractContextManager[list[Row]]]] = {
    QUIET: lambda robots: contextlib.nullcontext([]),
    FLOOD: _flood,
    "1 MB over the mesh": _transfer,
    "a CPU hog on each core": _hogs,
    "a full telemetry pipe": _full_pipe,
    UNKNOWN: lambda robots: contextlib.nullcontext([]),
}
"""What is in the way of the stops; each yields its own rows, which are complete when it ends."""


@dataclass
class Cell:
    """What the stops of one way under one condition took, s."""

    off: list[float] = field(default_factory=list)
    """From the stop to motors off."""
    said: list[float] = field(default_factory=list)
    """From motors off to the first `balancer/state` that says so."""
    started: list[float] = field(default_factory=list)
    """Until the program has given its stop."""
    lost: int = 0


@dataclass(frozen=True)
class Sizes:
    """How much the area measures."""

    count: int = COUNT
    """Stops in each cell of ways and conditions."""


FULL = Sizes()
SMOKE = Sizes(1)


def rows(sizes: Sizes) -> Iterator[Row]:
    """Measure; yields rows as they are there."""
    count, goal = sizes.count, 1.0
    quiet: dict[str, float] = {}
    lost = 0
    with RobotsOnALine() as robots:
        for condition, load in CONDITIONS.items():
            cells = {way: Cell() for way in WAYS}
            with load(robots) as about_load:
                # One of each way in turn, so that whatever else happens on this machine meets all of them.
                for _ in range(count):
                    for way, cell in cells.items():
                        _measure(robots, way, cell, newer=condition == UNKNOWN)
            yield from about_load
            for way, cell in cells.items():
                lost += cell.lost
                if condition == QUIET:
                    quiet[way] = statistics.median(cell.off) if cell.off else math.nan
                    yield Row(f"{way}, quiet: motors off, median", quiet[way], "s", BEYOND_S, None)
                    if WAYS[way] in (_by_estop, _by_ssh) and cell.started:
                        yield Row(f"{way}, quiet: until it is given", statistics.median(cell.started), "s", 1.0, None)
                beyond = _longest(cell) - quiet[way]
                yield Row(f"{way}, {condition}: longest beyond quiet", beyond, "s", BEYOND_S, goal)
            said = max((time for cell in cells.values() for time in cell.said), default=math.nan)
            yield Row(f"{condition}: balancer/state says so, longest", said, "s", STATE_S, goal)
    yield Row("stops that were lost", lost, "", 1.0, 0.0)


def _measure(robots: RobotsOnALine, way: str, cell: Cell, *, newer: bool) -> None:
    found = robots.stop(lambda: WAYS[way](robots, newer=newer))
    if found is None:
        cell.lost += 1
        return
    for values, value in zip((cell.off, cell.said, cell.started), found, strict=True):
        values.append(value)


def _longest(cell: Cell) -> float:
    """The longest time, since of so few stops nobody can tell a 99th percentile; not a number where one was lost."""
    return math.nan if cell.lost else max(cell.off)
