"""The live page of six robots at full rate and of two hundred, and what watching costs the swarm.

One simulation is watched and left alone by turns; iterations and the balancers' lateness of both come from its
recordings, so that nothing else than the watching differs. Browser and server run on the same machine as the robots
here, which they do not in a lab: what they take from the robots is in these pairs too. So there is a second simulation
that has one core to itself, watched and not, while server and browser have another one: what is left then is what
watching costs the robots' own processes.
"""

import asyncio
import contextlib
import math
import os
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from bench.costs.cpu import cpu_s
from bench.rigs.running import running
from bench.rigs.simulation import Simulation
from bench.rows import Row
from laptop.view import chromium
from swarm import clock
from swarm.core.percentile import percentile
from swarm.recording.core import json_text
from swarm.recording.reader import SUFFIX, RecordingReader

NAMES = tuple(f"r{index}" for index in range(6))
SIZE = (1400, 1000)
FRAME_S = 1 / 50
CROWD_FRAME_S = 1 / 20
PAINTED_S = 1 / 200
BROWSER = 0.20
SERVER = 0.10
"""Cores."""
SCREEN_S = 0.2
LEAST_SPREAD, MOST_SPREAD = 0.05, 0.1
"""What watching may cost is the spread of the turns without it, at least the first of these shares. Where they differ
by more than the second one, the machine was too busy for anything to be told from them."""

# Notes, for each new place of a robot, when it will have been drawn there: the time of the page's clock, s, behind the
# sample's. The newest of each robot is looked at with each frame.
NOTE = """(() => {
  const draw = swarmView.map.draw.bind(swarmView.map), seen = new Map();
  swarmView.ages = [];
  swarmView.map.draw = (now) => {
    draw(now);
    for (const [name, place] of swarmView.store.places) {
      if (seen.get(name) === place.at) continue;
      seen.set(name, place.at);
      swarmView.ages.push(Math.max(now, place.at + place.span) / 1000 - place.to.t);
    }
  };
})()"""

# How many frames a second the page comes to where each one is painted, as while robots drive, and how many those were.
FRAMES = """new Promise((resolve) => {
  const begin = performance.now();
  let frames = 0;
  const next = (now) => {
    swarmView.map.marks = [];
    swarmView.map.draw(now);
    if (now > begin + 2000) resolve([(1000 * frames) / (now - begin), frames]);
    frames += 1;
    requestAnimationFrame(next);
  };
  requestAnimationFrame(next);
})"""


@dataclass(frozen=True)
class Sizes:
    """How much the area measures."""

    turns: int = 3
    turn_s: float = 10.0
    settle_s: float = 3.0
    """For the page to load, and for the swarm to be alone again."""

    warm_up: int = 60
    crowd: int = 200
    crowd_s: float = 12.0


FULL = Sizes()
SMOKE = Sizes(1, 2.0, 1.0, 5, 20, 2.0)


@dataclass
class Seen:
    """What the turns with a page found."""

    frames: list[float] = field(default_factory=list)
    """A second, where all are wanted."""
    painted: list[float] = field(default_factory=list)
    """CPU time of the browser for one of them, s; all that the page does beside them is in it."""
    drawn: list[float] = field(default_factory=list)
    """Those that had to be drawn."""
    browser: list[float] = field(default_factory=list)
    """Cores."""
    server: list[float] = field(default_factory=list)
    ages: list[float] = field(default_factory=list)
    """s from a sample to the screen."""


def rows(sizes: Sizes = FULL) -> Iterator[Row]:
    """Measure; yields rows as they are there."""
    seen = Seen()
    middle = statistics.median
    pairs = _pairs("watched", seen, sizes)
    yield Row("6 robots, a frame of the page", 1 / middle(seen.frames), "s", FRAME_S, 1.0)
    yield Row("6 robots, CPU time of the browser for each of such frames", middle(seen.painted), "s", PAINTED_S, 1.0)
    yield Row("6 robots, frames that had to be drawn", middle(seen.drawn), "1/s", 60.0, None)
    yield Row("6 robots, browser", middle(seen.browser), "cores", BROWSER, 1.0)
    yield Row("6 robots, server", middle(seen.server), "cores", SERVER, 1.0)
    yield Row("robot to screen, half of them", middle(seen.ages), "s", SCREEN_S, 1.0)
    yield Row("robot to screen, 99 %", percentile(seen.ages, 99), "s", SCREEN_S, 1.0)
    yield from pairs
    cores = sorted(os.sched_getaffinity(0))
    if len(cores) > 1:
        yield from _pairs("watched from a core of its own", Seen(), sizes, (cores[0], cores[-1]))
    with tempfile.TemporaryDirectory(prefix="swarm-") as folder:
        seconds = sizes.crowd_s + 2 * sizes.settle_s
        options = ["--virtual", "--robots", str(sizes.crowd), "--seconds", str(seconds), "--record", folder]
        command = [sys.executable, "-m", "laptop.cli", "sim", "consensus", *options]
        subprocess.run(command, check=True, capture_output=True)
        crowd = Seen()
        _turn([folder], sizes.crowd_s, sizes.settle_s, crowd)
    yield Row(f"{sizes.crowd} robots of a recording, a frame", 1 / crowd.frames[0], "s", CROWD_FRAME_S, 1.0)
    yield Row(f"{sizes.crowd} robots of a recording, browser", crowd.browser[0], "cores", 1.0, None)
    yield Row(f"{sizes.crowd} robots of a recording, server", crowd.server[0], "cores", SERVER, None)


def _pairs(how: str, seen: Seen, sizes: Sizes, cores: tuple[int, int] | None = None) -> list[Row]:
    """Six robots, watched and left alone by turns. With `cores` the robots have the first, who watches the second."""
    alone, watched = list[tuple[float, float]](), list[tuple[float, float]]()
    free = os.sched_getaffinity(0)
    try:
        if cores is not None:
            os.sched_setaffinity(0, cores[:1])  # for all that is started from now on
        with Simulation("consensus", "--robots", "6", "--seconds", "3600") as simulation:
            if cores is not None:
                os.sched_setaffinity(0, cores[1:])
            simulation.wait_for("r0", sizes.warm_up)
            for _ in range(sizes.turns):
                asyncio.run(asyncio.sleep(sizes.settle_s))
                begin = clock.now()
                asyncio.run(asyncio.sleep(sizes.turn_s))
                alone.append((begin, clock.now()))
                where = ["--run-dir", str(simulation.run_dir)]
                watched.append(_turn(where, sizes.turn_s, sizes.settle_s, seen))
            iterations = [_iterations(simulation.records, windows) for windows in (alone, watched)]
            lateness = [_lateness(simulation.records, windows) for windows in (alone, watched)]
    finally:
        os.sched_setaffinity(0, free)
    rows, middle = [], statistics.median
    for name, (left, looked) in (("a lockstep iteration", iterations), ("lateness of balancers, p99", lateness)):
        noise = (max(left) - min(left)) / middle(left)
        rows.append(Row(f"{name}: unwatched, spread of the turns", noise, "1", 1.0, None))
        seen_s = middle(looked) if noise <= MOST_SPREAD else math.nan
        rows.append(Row(f"{name}: {how} beside unwatched", seen_s, "s", middle(left), 1.0 + max(LEAST_SPREAD, noise)))
    return rows


def _turn(arguments: list[str], seconds: float, settle_s: float, seen: Seen) -> tuple[float, float]:
    """Watch with a page for a while; from when to when."""
    command = [sys.executable, "-m", "laptop.cli", "view", "--no-open", *arguments]
    with running(command, stdout=subprocess.PIPE, text=True) as server:
        assert server.stdout is not None
        return asyncio.run(_watch(server.stdout.readline().strip(), server.pid, seconds, settle_s, seen))


async def _watch(address: str, server: int, seconds: float, settle_s: float, seen: Seen) -> tuple[float, float]:
    async with chromium.opened(address, SIZE) as page:
        await page.until("Boolean(window.swarmView?.store.swarm)")
        await asyncio.sleep(settle_s)
        # The page's clock beside ours, as the question that was answered soonest tells it.
        asked = [(clock.now(), await page.evaluate("performance.now() / 1000"), clock.now()) for _ in range(20)]
        before, there, after = min(asked, key=lambda times: times[2] - times[0])
        ahead = (before + after) / 2 - there
        await page.evaluate(NOTE)
        begin, first = clock.now(), await _counts(page, server)
        await asyncio.sleep(seconds)
        end, last = clock.now(), await _counts(page, server)
        drawn, browser, served = ((b - a) / (end - begin) for a, b in zip(first, last, strict=True))
        before = sum(map(cpu_s, _group(page.pid)))
        rate, count = await page.evaluate(FRAMES)
        seen.frames.append(rate)
        seen.painted.append((sum(map(cpu_s, _group(page.pid))) - before) / count)
        seen.drawn.append(drawn)
        seen.browser.append(browser)
        seen.server.append(served)
        seen.ages += [age + ahead for age in await page.evaluate("swarmView.ages")]
        return begin, end


async def _counts(page: chromium.Page, server: int) -> tuple[float, float, float]:
    """Frames drawn, CPU time of browser and server, s."""
    return await page.evaluate("swarmView.map.drawn"), sum(map(cpu_s, _group(page.pid))), cpu_s(server)


def _group(leader: int) -> list[int]:
    """Processes of a process group."""
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            with contextlib.suppress(OSError):
                fields = (entry / "stat").read_text().rpartition(") ")[2].split()
                if int(fields[2]) == leader:
                    found.append(int(entry.name))
    return found


def _iterations(records: Path, windows: list[tuple[float, float]]) -> list[float]:
    """Time of an iteration in each window, s: mean of all robots."""

    def of(rows: list[tuple[float, Any]]) -> float:
        (t0, first), (t1, last) = rows[0], rows[-1]
        return (t1 - t0) / float(last["k"] - first["k"])

    return _each(records, "app/consensus/state", windows, of)


def _lateness(records: Path, windows: list[tuple[float, float]]) -> list[float]:
    """How late the balancers' steps began in each window, s: the middle of the 99th percentiles of each second."""
    return _each(records, "balancer/state", windows, lambda rows: statistics.median(row["late_p99"] for _, row in rows))


def _each(
    records: Path, topic: str, windows: list[tuple[float, float]], of: Callable[[list[tuple[float, Any]]], float]
) -> list[float]:
    """The mean over all robots of what `of` makes of their messages in each window."""
    found: list[list[float]] = [[] for _ in windows]
    for name in NAMES:
        reader = RecordingReader(records / f"{name}.consensus{SUFFIX}")
        messages = [
            (message["t"], message)
            for sample in reader.samples()
            if sample.topic == f"swarm/{name}/{topic}" and isinstance(message := json_text.decode(sample.data), dict)
        ]
        for window, (begin, end) in zip(found, windows, strict=True):
            window.append(of([row for row in messages if begin <= row[0] <= end]))
    return [statistics.mean(window) for window in found]
