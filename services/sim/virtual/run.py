"""`swarm sim APP --virtual`: one run under virtual time, with the report of the real one."""

import os
import random
import time as real_time
from collections.abc import Mapping
from pathlib import Path

from services.apps import loader
from services.apps.recorder import Recorder
from services.mesh.core.delay import AirModel
from services.sim.options import Options
from services.sim.options import parse as arguments_of
from services.sim.report import Json, Outcome, summary
from services.sim.scenario import Scenario, build
from services.sim.trajectory import EMPTY, Trajectory
from services.sim.virtual.sync import Line, SyncHost
from services.sim.virtual.world import World
from swarm.codec import Value
from swarm.errors import LocalError

STALLED = 60.0
"""s of virtual time without any iteration after which a run is given up: it costs no patience to wait so long."""
LOOK_EVERY = 1.0
"""s of virtual time between two looks whether it is to end."""

PLACE = Path("/virtual")
"""Stands for the run directory in the configuration of a run, which has none."""

_NEVER = float("inf")


class Run:
    """Runs a scenario until its end."""

    def __init__(self, options: Options, scenario: Scenario, *, rows: bool = False) -> None:
        """`rows`: keep the states of all iterations for the outcome, not only the last."""
        self._options = options
        self._scenario = scenario
        self._rows = rows or bool(scenario.recordings) or options.plot is not None
        names = scenario.config.names
        model = AirModel(options.latency, options.jitter, options.bandwidth, options.seed)
        self.world = World(scenario.config, model, options.seed)
        self._tapes = {name: _Tape(keep=self._rows) for name in names}
        self._recorders: dict[str, Recorder] = {}
        self._running = set(names)
        self._missing_first = set(names)
        self._started: float | None = None
        self._last_progress = 0.0
        self._problems: list[str] = []
        self.computed = 0.0
        """s of real time that it took."""

    def go(self) -> Outcome:
        """The whole run."""
        options, scenario, world = self._options, self._scenario, self.world
        began = real_time.perf_counter()
        if scenario.program is not None:
            app = loader.load(scenario.program)
            number = random.Random(f"{options.seed} run").getrandbits(64)
            for name in scenario.config.names:
                world.start_app(
                    name,
                    app,
                    run=number,
                    last=scenario.iterations,
                    measurements=None,
                    advanced=self._advanced,
                    ended=self._ended,
                )
        else:
            self._first_done()
        self._watch()
        ended_at = world.time.now
        for recorder in self._recorders.values():
            recorder.close()
        self.computed = real_time.perf_counter() - began
        return self._outcome(ended_at)

    def _watch(self) -> None:
        """Let time pass until the run is over, looking now and then whether anything still moves."""
        time, seconds = self.world.time, self._options.seconds
        while True:
            end = _NEVER if seconds is None or self._started is None else self._started + seconds
            if not time.run(min(time.now + LOOK_EVERY, end)) or time.now >= end:
                return
            if self._scenario.app is not None and time.now > self._last_progress + STALLED:
                stuck = [f"{name} waits for {', '.join(host.waiting)}" for name, host in self._hosts() if host.waiting]
                self._problems.append(f"no iteration for {STALLED:g} s: {'; '.join(stuck) or 'the apps say nothing'}")
                return

    def _hosts(self) -> list[tuple[str, SyncHost]]:
        return [(name, host) for name, robot in self.world.robots.items() for host in robot.apps.values()]

    def _advanced(self, host: SyncHost, line: Line) -> None:
        """A robot has done an iteration."""
        name = host.robot
        self._last_progress = line.t
        self._tapes[name].write(host, line)
        if self._options.record is not None:
            recorder = self._recorders.get(name)
            if recorder is None:
                path = self._options.record / f"{name}.{host.name}.csv"
                recorder = Recorder(path, host.runner.schema, self.world.robots[name].mesh.counters, append=False)
                self._recorders[name] = recorder
            recorder.write(line.k, line.t, line.state, line.result)
        if line.k >= 1 and self._started is None:
            self._missing_first.discard(name)
            if not self._missing_first:
                self._first_done()

    def _first_done(self) -> None:
        """All robots have done their first iteration: the cuts' times count from here."""
        self._started = now = self.world.time.now
        for cut in self._options.cuts:
            self.world.cut(cut.a, cut.b, now + cut.at, cut.seconds)

    def _ended(self, host: SyncHost) -> None:
        """A robot is at its last iteration, or its app has failed: that ends the run."""
        if host.fault:
            self._problems.append(f"{host.robot} app {host.fault}")
            self.world.time.stop()
            return
        self._running.discard(host.robot)
        if not self._running and self._options.seconds is None:
            self.world.time.stop()

    def _outcome(self, ended_at: float) -> Outcome:
        names = self._scenario.config.names
        started = self._started
        frames = sum(robot.mesh.counters["sent_sync"] for robot in self.world.robots.values())
        return Outcome(
            scenario=self._scenario,
            seed=self._options.seed,
            started_s=started,
            seconds=0.0 if started is None else ended_at - started,
            trajectories={name: tape.trajectory() for name, tape in self._tapes.items()} if self._scenario.app else {},
            bodies=dict.fromkeys(names),
            messages=frames,
            rss_mib={},
            restarts=dict.fromkeys(names, 0),
            problems=tuple(self._problems),
            computed_s=self.computed,
        )


class _Tape:
    """What is kept of one robot's iterations: when each was done, and the states of all or of the last."""

    def __init__(self, *, keep: bool) -> None:
        self._keep = keep
        self._times: dict[int, float] = {}
        self._lines: dict[int, Line] = {}
        self._host: SyncHost | None = None

    def write(self, host: SyncHost, line: Line) -> None:
        """One iteration."""
        self._host = host
        self._times[line.k] = line.t
        if not self._keep:
            self._lines.clear()
        self._lines[line.k] = line

    def trajectory(self) -> Trajectory:
        """As the recorder would have written it."""
        if self._host is None:
            return EMPTY
        shared = [column for field in self._host.runner.schema.fields for column in field.columns]
        results: list[str] = []
        for name, value in next(iter(self._lines.values())).result.items():
            parts = [f"[{index}]" for index in range(len(value))] if isinstance(value, tuple) else [""]
            results += [f"result.{name}{part}" for part in parts]
        rows = {k: tuple(_cells(line.state) + _cells(line.result)) for k, line in self._lines.items()}
        return Trajectory((*shared, *results), self._times, rows)


def _cells(values: Mapping[str, Value]) -> list[str]:
    found: list[str] = []
    for value in values.values():
        found += [str(each) if isinstance(each, str) else repr(each) for each in _parts(value)]
    return found


def _parts(value: Value) -> tuple[Value, ...]:
    return value if isinstance(value, tuple) else (value,)


def simulate(*arguments: str, rows: bool = False) -> tuple[Json, Outcome]:
    """Run `swarm sim ARGUMENTS --virtual` in this process: the report of `--json`, and what it was made from."""
    options = arguments_of([*arguments, "--virtual"])
    if options.record is not None:
        make_records(options.record)
    outcome = Run(options, build(options, PLACE), rows=rows).go()
    return summary(outcome), outcome


def make_records(directory: Path) -> None:
    """Recordings are never written over: a run's data may be all there is of an experiment."""
    directory.mkdir(parents=True, exist_ok=True)
    if any(os.scandir(directory)):
        raise LocalError(f"--record {directory}: the folder is not empty; name a new one")
