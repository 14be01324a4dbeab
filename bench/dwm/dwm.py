"""What the UWB service costs a robot: memory of its process, and CPU time and memory traffic of one 10 Hz update."""

import random
import time
import timeit
import tracemalloc
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

from bench.costs import footprint
from bench.costs.memory import LIMIT_MB_H
from bench.rows import Row
from services.dwm.core.estimation.pipeline import Pipeline
from services.dwm.core.module.diagnosis import DiagnosisWatch
from services.dwm.core.module.poller import ModuleReport, Poller
from services.dwm.core.module.tlv import Position, encode_location
from sim.core.uwb import Module, Tag
from sim.processes.run import SERVICE_MODULES
from swarm.config.types import Anchor, Dwm
from swarm.messages.codec import encode

MEMORY_MIB = 35.0
UPDATE_S = 0.002
"""A fiftieth of the 100 ms between updates. A Pi Zero 2 W is taken for ten times as slow: a fifth of one core."""
HELD_B = LIMIT_MB_H * 1e6 / 36_000
"""What an update may keep: what an hour of 36 000 updates may add to a process."""
PEAK_KIB = 512.0
"""What it may take for the moment; 256 KiB are a buffer of msgpack, of which only the first pages are touched."""
PREDICTIONS = 3
"""Odometry messages between two reports: they come at 25 Hz."""
LEG = 50
STEP = 0.02
"""m between two updates."""

ANCHORS = (
    Anchor("D001", 0.0, 0.0),
    Anchor("D002", 1.94, 0.0),
    Anchor("D003", 1.0, 1.94),
    Anchor("D004", 2.0, 2.0),
)


@dataclass(frozen=True)
class Sizes:
    """How much the area measures."""

    updates: int = 600
    warm_up: int = 2500
    """Updates until the filter knows its heading and the interpreter's free lists (2000 tuples of a length) are
    full."""

    settle_s: float = footprint.FULL.settle_s


FULL = Sizes()
SMOKE = Sizes(10, 20, footprint.SMOKE.settle_s)


def rows(sizes: Sizes = FULL) -> Iterator[Row]:
    """Measure; yields rows as they are there."""
    yield Row("dwm process, proportional memory", _memory(sizes.settle_s), "MiB", MEMORY_MIB, 1.0)
    for kind in ("ekf", "multilateration", "average"):
        update = _updates(kind)
        for _ in range(sizes.warm_up):
            update()
        batch = sizes.updates // 5
        seconds = min(timeit.repeat(update, number=batch, repeat=5, timer=time.process_time)) / batch
        yield Row(f"one 10 Hz update with four anchors, {kind}", seconds, "s", UPDATE_S, 1.0)
        held, peak = _allocated(update, sizes.updates)
        yield Row(f"held after an update, {kind}", held, "B", HELD_B, 1.0)
        yield Row(f"peak of an update, {kind}", peak / 1024, "KiB", PEAK_KIB, 1.0)


def _updates(kind: str) -> Callable[[], None]:
    """From the line's bytes to the messages' bytes: what the service does ten times a second, without IO."""
    modules = [Module(a.address, a.x, a.y, a.z, Position(a.x, a.y, a.z, 100)) for a in ANCHORS]
    tag = Tag(random.Random(1))
    pipeline = Pipeline(replace(Dwm(), filter=kind), {}, kind=kind, anchors=ANCHORS)
    watch = DiagnosisWatch(ANCHORS, {}, 0.0)
    poller = Poller(10.0, 0.0)
    # Forward by a metre at 0.2 m/s and back again.
    way = [*range(LEG), *range(LEG, 0, -1)]
    answers = [encode_location(tag.measure(modules, 0.5 + STEP * step, 1.2, 0.0)) for step in way]
    now, count = 0.0, 0

    def update() -> None:
        nonlocal now, count
        count += 1
        now += 0.1
        for part in range(PREDICTIONS):
            way_on = STEP if count % (2 * LEG) < LEG else -STEP
            pipeline.tracker.odometry(now - 0.1 + 0.033 * part, way_on / PREDICTIONS, 0.0, 0.01)
        poller.handle_timer(now)
        poller.to_send()
        poller.receive(answers[count % len(answers)], now + 0.02)
        for event in poller.events():
            if isinstance(event, ModuleReport):
                watch.report(event.location, now)
                for message in pipeline.report(event.location, now):
                    encode(message)

    return update


def _allocated(update: Callable[[], None], updates: int) -> tuple[float, float]:
    """Bytes that stay after an update (mean of many), and the most that one takes meanwhile."""
    tracemalloc.start()
    for _ in range(updates):  # what takes the place of something older that is not traced is no growth
        update()
    before, _ = tracemalloc.get_traced_memory()
    peak = 0
    for _ in range(updates):
        tracemalloc.reset_peak()
        start, _ = tracemalloc.get_traced_memory()
        update()
        peak = max(peak, tracemalloc.get_traced_memory()[1] - start)
    held = tracemalloc.get_traced_memory()[0] - before
    tracemalloc.stop()
    return max(0.0, held / updates), float(peak)


def _memory(settle_s: float) -> float:
    """Proportional set size of the service at a simulated module, one robot alone, MiB."""
    services = {service: SERVICE_MODULES[service] for service in ("bus", "balancer", "dwm")}
    with footprint.robot_alone(services, settle_s) as memory:
        return memory["dwm"]
