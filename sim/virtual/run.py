"""`swarm sim APP --virtual`: one run under virtual time, with the report of the real one."""

import contextlib
import gc
import math
import random
import time as real_time
from collections.abc import Callable, Collection, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

from services.apps import loader
from services.apps.equipment.speaker import prints_heard
from services.apps.host.event_host import EventHost
from services.apps.host.observer import Observer, Source, StepRecord
from services.dwm.replay import measured
from services.mesh.links.radio_model import AirModel
from sim import scene
from sim.core import actions
from sim.core.scene_record import SceneRecord
from sim.disturbances import Cut, Disturbance, Kill, Off, ScheduledPress, ScheduledPush, never
from sim.report import Json, RunOutcome, fault, notes, summary
from sim.scenario.options import PRESS_S, Options
from sim.scenario.options import parse as arguments_of
from sim.scenario.scenario import Scenario, build
from sim.virtual.apps.app_records import AppRecords
from sim.virtual.apps.hang import broken_off
from sim.virtual.mesh_choice import mesh_of
from sim.virtual.world import Launch, VirtualWorld
from swarm.app.run_options import RunOptions
from swarm.config.dump import dump
from swarm.core.lockstep.stopping import is_unmet
from swarm.errors import ConfigError, LocalError
from swarm.messages import AppEpoch, AppLog, AppParameters
from swarm.recording import folder
from swarm.recording.recorded_topics import TOPICS

STALLED = 60.0
"""Seconds of virtual time without any iteration after which a run is given up: it costs no patience to wait so long."""
ENDLESS = 120.0
"""Seconds of virtual time after the start, and the last button, at which an app without iterations ends that never
rests."""
LOOK_EVERY = 1.0
"""Seconds of virtual time between two looks whether it is to end."""

PLACE = Path("/virtual")
"""Path that stands for the run directory, which a virtual run does not have, in its configuration."""

_NEVER = float("inf")


@contextlib.contextmanager
def _without_looking_for_garbage() -> Iterator[None]:
    """Look for no garbage within this: the robots live to the end and make no circles. Going through millions of their
    objects again and again takes a third of the time."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


class VirtualRun:
    """Runs a scenario until its end."""

    @_without_looking_for_garbage()
    def __init__(
        self,
        options: Options,
        scenario: Scenario,
        *,
        rows: bool = False,
        topics: Collection[str] = tuple(TOPICS),
        look: Callable[[float], None] | None = None,
        said: Callable[[str, AppLog], None] | None = None,
    ) -> None:
        """`rows`: keep the states of all iterations for the outcome, not only the last. `topics`: what a recording
        holds beside what the app says, of those of `swarm.recording.recorded_topics`. `look(share)` is called at each
        second of virtual time with the share of the run that is done, 0 to 1; `said(robot, line)` with what
        apps print and log."""
        self._options = options
        self._scenario = scenario
        self._rows = rows or bool(scenario.recordings)
        self._topics = topics
        self._look = look
        names = scenario.config.names
        if scenario.iterations is None and not (options.slots or options.latency or options.jitter):
            raise ConfigError("--latency 0: such a run needs --iterations, since it takes no time and never ends by it")
        model = AirModel(options.latency, options.jitter, options.bandwidth, options.seed, loss=options.loss)
        self._scene_record = SceneRecord(names) if scenario.built_in in scene.WATCHED else None
        self.world = VirtualWorld(
            scenario.config,
            model,
            options.seed,
            body=options.body,
            mesh=mesh_of(options, scenario),
            lying=scenario.lying,
            skew=options.clock_skew,
            scene_record=self._scene_record,
            slots=options.slots,
            processes_end=any(isinstance(each, Kill) for each in scenario.disturbances),
        )
        apps = [each.app for each in scenario.beside] + ([scenario.app] if scenario.app else [])
        if said is not None:
            self.world.hearers = {(name, app): [partial(said, name)] for name in names for app in apps}
        self._records = self._records_of(scenario.app or "")
        self._beside = {each.app: self._records_of(each.app) for each in scenario.beside}
        self._late = scenario.late
        self._happened: list[Disturbance] = []
        """The disturbances whose time has come."""
        self._impossible: list[str] = []
        """One sentence for each disturbance that was not possible when its time had come."""
        self._running = set(names)
        self._missing_first = set(names) - self._late.keys() or set(names)
        self._epoch = (0, 0)
        """Counter and number of the newest epoch."""
        self._members = frozenset(names)
        """Members of the newest epoch."""
        self._started: float | None = None
        self._last_progress = max(self._late.values(), default=0.0)
        self._newest = 0
        """The iteration that a robot did last."""
        self._problems: list[str] = []
        self.computed = 0.0
        """Seconds of real time that the run took."""

    @_without_looking_for_garbage()
    @broken_off()
    def go(self) -> RunOutcome:
        """Run from beginning to end."""
        began = real_time.perf_counter()
        self._run()
        self._problems += self._lost()
        outcome = self._outcome(self.world.time.now)
        for records in (self._records, *self._beside.values()):
            records.close(notes(outcome))
        self.computed = real_time.perf_counter() - began
        return replace(outcome, computed_s=self.computed)

    @prints_heard()
    def _run(self) -> None:
        """Start all apps, and let time pass."""
        scenario, world = self._scenario, self.world
        if scenario.loaded is not None:
            launches = [self._launch(scenario.loaded, "", scenario.run_options, self._records, self)]
            for each in scenario.beside:
                records = self._beside[each.app]
                beside = _Beside(records, self._problems)
                launches.append(self._launch(each.loaded, f" {each.app}", scenario.run_options_beside, records, beside))
            for name, seconds in self._late.items():
                world.switch_off(name, seconds, falls=False)
            rows = {name: partial(measured, recording) for name, recording in scenario.recordings.items()}
            for launch in launches:
                for name in scenario.config.names:
                    world.start_app(name, launch._replace(rows=rows.get(name)), after=self._late.get(name, 0.0))
        else:
            self._first_done()
        self._watch()

    def _records_of(self, app: str) -> AppRecords:
        return AppRecords(self.world, app, keep=self._rows, skewed=bool(self._options.clock_skew))

    def _launch(
        self, app: loader.LoadedApp, which: str, run_options: RunOptions, records: AppRecords, observer: Observer
    ) -> Launch:
        """Return how an app is to be started; its recording has begun. `which` gives each app a number with which
        its tickets of requests begin."""
        place, scenario = self._options.record, self._scenario
        number = random.Random(f"{self._options.seed} run{which}").getrandbits(64)
        if place is not None:
            files = {folder.CONFIG_FILE: dump(scenario.config).encode()}
            if not app.is_built_in and app.text:
                files[f"{app.name}.py"] = app.text
            folder.begin(place, folder.describe(app.name, number, self._options.seed, app.digest), files)
            records.record(place, app, number, self._topics)
        return Launch(app, number, run_options, None, observer)

    def _watch(self) -> None:
        """Let time pass until the run is over, looking now and then whether anything still moves."""
        time, seconds = self.world.time, self._options.seconds
        lasts = seconds
        if seconds is None and self._scenario.app is not None and not self._scenario.steps:
            lasts = ENDLESS + max((each.at for each in self._scenario.disturbances if each.at is not None), default=0.0)
        while True:
            end = _NEVER if lasts is None or self._started is None else self._started + lasts
            if not time.run(min(time.now + LOOK_EVERY, end)) or time.now >= end:
                return
            if self._look is not None and self._started is not None:
                last, past = self._scenario.iterations, time.now - self._started
                self._look(min(1.0, past / lasts if lasts is not None else self._newest / last if last else 0.0))
            waits = seconds is None or self._started is None
            if waits and self._scenario.app is not None and time.now > self._last_progress + STALLED:
                self._stalled()
                return

    def _stalled(self) -> None:
        """End the run after a long time without events: as done for an app that waits for events, as a problem for
        others."""
        app = self._scenario.app
        hosts = [robot.apps[app] for robot in self.world.robots.values() if app in robot.apps]
        sources = [
            each for host in hosts for each in ([host] if isinstance(host, EventHost) else host.drivers.values())
        ]
        if sources and all(_has_no_steps(each) for each in sources):
            return
        found = [(each.robot, each.progress) for each in sources]
        stuck = [
            progress.reason or f"{robot} waits for {', '.join(progress.waiting_for)}"
            for robot, progress in found
            if progress.phase == "waiting"
        ]
        self._problems.append(f"no iteration for {STALLED:g} s: {'; '.join(stuck) or 'the apps say nothing'}")

    def _lost(self) -> list[str]:
        """Return the apps that react to events and whose locksteps have lost their state: they would wait for ever.
        `_stalled` tells of apps with iterations."""
        app = self._scenario.app or ""
        hosts = [(name, robot.apps.get(app)) for name, robot in self.world.robots.items()]
        return [
            f"{name} app channel {channel}: {reason}"
            for name, host in hosts
            if isinstance(host, EventHost) and host.channels is not None
            for channel, reason in host.channels.obstacles.items()
        ]

    def advanced(self, source: Source, line: StepRecord) -> None:
        """See `Observer`: a robot has done an iteration."""
        self._last_progress = self.world.time.now
        self._newest = line.k
        self._records.advanced(source, line)
        if not source.part and self._started is None and (line.k >= 1 or _has_no_steps(source)):
            self._missing_first.discard(source.robot)
            self._look_whether_begun()

    def progressed(self, source: Source) -> None:
        self._records.progressed(source)

    def parameters(self, robot: str, parameters: AppParameters) -> None:
        self._records.parameters(robot, parameters)

    def _first_done(self) -> None:
        """Begin the times of cuts and acts: all robots have done their first iteration."""
        self._started = self.world.modules.moves_from = now = self.world.time.now
        for each in self._scenario.disturbances:
            if each.at is not None:
                self.world.time.at(now + each.at, self._let_happen, each)
        if self._options.seconds is not None:
            self.world.time.at(now + self._options.seconds, self.world.time.stop)

    def _let_happen(self, what: Disturbance) -> None:
        self._happened.append(what)
        self._last_progress = self.world.time.now  # what follows of it may take as long again
        try:
            self._do(what)
        except LocalError as error:
            self._impossible.append(f"{what}: {error}")

    def _do(self, what: Disturbance) -> None:
        match what:
            case ScheduledPress(robot, button):
                self.world.act(robot, actions.Press(button, PRESS_S))
            case ScheduledPush(robot, _, impulse):
                self.world.act(robot, actions.Push(impulse))
            case Cut(a, b, _, seconds):
                self.world.air.cut(a, b, seconds)
            case Off(robot, _, seconds):
                self.world.switch_off(robot, seconds)
            case Kill(robot, "mesh"):
                self.world.kill_mesh(robot)
            case Kill(robot):
                self.world.kill_app(robot, self._scenario.app or "")

    def ended(self, source: Source) -> None:
        """See `Observer`: a robot is at its last iteration, or its app has failed. That ends the run."""
        self._records.progressed(source)
        if (progress := source.progress).phase == "fault":
            self._problems.append(fault(source.robot, "app", progress.reason))
            if not self._scenario.run_options.drop:
                self.world.time.stop()
                return
            self._missing_first.discard(source.robot)  # the others go on without it
            self._look_whether_begun()
        elif is_unmet(progress.reason) and progress.reason not in self._problems:
            self._problems.append(progress.reason)
        if source.part:
            return
        self._running.discard(source.robot)
        self._look_whether_over()

    def switched(self, source: Source, epoch: AppEpoch) -> None:
        """See `Observer`: the members have changed."""
        name = source.robot
        self._last_progress = self.world.time.now
        self._records.switched(source, epoch)
        if source.part:
            return
        if name in epoch.members:
            self._running.add(name)
        if (epoch.epoch, epoch.frames) > self._epoch:
            self._epoch = epoch.epoch, epoch.frames
            self._members = frozenset(epoch.members)
            self._missing_first &= self._members
            self._look_whether_begun()
            self._look_whether_over()

    def _look_whether_begun(self) -> None:
        if self._started is None and not self._missing_first:
            self._first_done()

    def _look_whether_over(self) -> None:
        """Stop if all members are done. Robots without which the others go on do not count."""
        if self._options.seconds is None and self._running.isdisjoint(self._members):
            self.world.time.stop()

    def _never(self, ended_at: float) -> tuple[str, ...]:
        started = ended_at if self._started is None else self._started
        # A robot that comes late is started a second time then.
        planned = self._scenario.disturbances
        come = [each for each in planned if each.at is None and self.world.robots[each.robot].starts > 1]
        left = [each for each in planned if each not in (*come, *self._happened)]
        return (*self._impossible, *never(left, ended_at - started))

    def _seen(self) -> Json:
        return scene.seen(self._scenario, self._scene_record, self.world.contacts, 0.0, self._started)

    def _outcome(self, ended_at: float) -> RunOutcome:
        names = self._scenario.config.names
        started = self._started
        return RunOutcome(
            scenario=self._scenario,
            seed=self._options.seed,
            started_s=started,
            seconds=0.0 if started is None else ended_at - started,
            trajectories=self._records.trajectories() if self._scenario.app else {},
            beside={name: records.trajectories() for name, records in self._beside.items()},
            bodies={name: robot.balancer.state() for name, robot in self.world.robots.items()},
            messages=self.world.sent,
            rss_mib={},
            restarts={
                name: max(0, self.world.robots[name].starts - (2 if name in self._late else 1)) for name in names
            },
            problems=tuple(self._problems),
            missing=tuple(name for name in names if name not in self._members),
            moves_from=math.inf if started is None else started,
            never=self._never(ended_at),
            scene=self._seen(),
        )


class _Beside:
    """Observes an app beside the one that the run is about: where it ends, the others go on."""

    def __init__(self, records: AppRecords, problems: list[str]) -> None:
        self._problems = problems
        self.advanced = records.advanced
        self.progressed = self._progressed = records.progressed
        self.switched = records.switched
        self.parameters = records.parameters

    def ended(self, source: Source) -> None:
        self._progressed(source)
        if (progress := source.progress).phase == "fault":
            self._problems.append(fault(source.robot, source.app, progress.reason))


def _has_no_steps(source: Source) -> bool:
    """Return whether a source waits for events alone."""
    return isinstance(source, EventHost) and source.runner.period is None


def run_virtually(*arguments: str, rows: bool = False, app: loader.LoadedApp | None = None) -> tuple[Json, RunOutcome]:
    """Run `swarm sim ARGUMENTS --virtual` in this process: the report of `--json`, and what it was made from. `app`:
    see `build`."""
    options = arguments_of([*arguments, "--virtual"])
    if options.record is not None:
        folder.make_empty(options.record)
    outcome = VirtualRun(options, build(options, PLACE, app), rows=rows).go()
    return summary(outcome), outcome
