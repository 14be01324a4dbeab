"""A run of a simulated swarm, from the start of its processes to its results."""

import contextlib
import json
import math
import os
import signal
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TextIO

from sim import scene
from sim.control import datagrams
from sim.control.app_requests_server import Orders
from sim.control.link_cuts import cut_link
from sim.control.power_server import Power
from sim.core import actions
from sim.disturbances import (
    NOT_RUNNING,
    SWITCHED_OFF,
    Cut,
    Disturbance,
    Kill,
    Off,
    ScheduledPress,
    ScheduledPush,
    never,
)
from sim.processes import findings, footprint
from sim.processes.monitor import START_LIMIT_S, Monitor, Seen, StartTimeout, unrecorded
from sim.processes.processes import APP_FAULT, Child, Processes
from sim.processes.progress import ProgressDisplay
from sim.processes.radio import LATENESS
from sim.report import RunOutcome
from sim.scenario.options import PRESS_S, Options
from sim.scenario.scenario import Scenario
from sim.world import BodyWorld
from swarm import clock
from swarm.config.dump import dump
from swarm.core.lockstep.stopping import is_unmet
from swarm.errors import LocalError
from swarm.recording import folder, trajectory
from swarm.recording.file import check_room
from swarm.recording.reader import SUFFIX

SERVICE_MODULES = {
    "bus": "services.bus",
    "mesh": "services.mesh",
    "balancer": "sim.body",
    "dwm": "services.dwm",
}
"""Every robot's services and the modules that run them; the balancer gets a simulated body. An app comes on top."""
APP_SERVICE = "services.apps"
RADIO, RADIO_MODULE = "radio", "sim.processes.radio"
"""Name and module of the process that is the radio of all robots, where they have one (`--radio slots`)."""

ASK_S, ASK_AGAIN_S = 1.0, 5.0
"""Seconds between two questions to all services for how they are, until the swarm has started, and then. They say so
themselves when it changes."""

TICK_S = 0.05
REFRESH_LIMIT_S = 0.5


class ProcessRun:
    """Starts a swarm, watches it until it is done, and ends it. Use as a context: leaving it ends every process."""

    def __init__(self, options: Options, scenario: Scenario, run_dir: Path, stream: TextIO) -> None:
        self._options = options
        self._scenario = scenario
        self._run_dir = run_dir
        self._records = (options.record or run_dir / "records").absolute()
        self._commanded = footprint.commanded()
        self._progress = ProgressDisplay(stream, scenario)
        self._problems: list[str] = []
        self._moves_from = math.inf
        self._stop = False
        self._signal = 0
        names = scenario.config.names
        folder.make_empty(self._records)
        check_room(self._records)
        for name in (*names, *([RADIO] if options.slots is not None else [])):
            (run_dir / name).mkdir()
        (run_dir / "swarm.toml").write_text(dump(scenario.config))
        self._services = (*SERVICE_MODULES, *([f"app/{scenario.app}"] if scenario.app else []))
        self._beside = {f"app/{each.app}": each for each in scenario.beside}
        number = os.urandom(8)
        if scenario.loaded is not None and scenario.beside:  # else the apps' processes begin the folder all alike
            digest = scenario.loaded.digest
            about = folder.describe(scenario.loaded.name, int.from_bytes(number, "big"), options.seed, digest)
            folder.begin(self._records, about, {})
        self._processes = Processes(self._environment(number.hex()))
        self._monitor = Monitor(run_dir, names, scenario.app)
        self._orders = Orders(run_dir, self._processes, names, self._start_app)
        self._world = BodyWorld(run_dir, scenario.config, options.seed, self._monitor.truth)
        self._power = Power(run_dir, names, self._processes)
        self._late = scenario.late
        """Robots that are still to come, and when, s after the command."""
        timed = (each for each in scenario.disturbances if each.at is not None)
        self._disturbances = sorted(timed, key=lambda each: each.at or 0.0)
        """The disturbances that are still to happen."""
        self._impossible: list[str] = []
        """One sentence for each disturbance that was not possible when its time had come."""

    def __enter__(self) -> "ProcessRun":
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._interrupted)
        for note in self._scenario.notes:
            self._progress.say(note)
        if (radio := self._options.slots) is not None:
            words = [RADIO_MODULE, radio.text(), str(self._options.seed)]
            self._processes.add(RADIO, RADIO, words, self._run_dir / RADIO)
        for name in self._scenario.config.names:
            if name not in self._late:
                self._start_robot(name)
        return self

    def __exit__(self, *_: object) -> None:
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, signal.SIG_IGN)  # the end goes through, it takes at most a few seconds
        self._orders.close()
        self._monitor.close()
        self._processes.stop()
        self._world.close()
        self._power.close()
        self._progress.close()

    def watch(self) -> RunOutcome:
        """Follow the run until its end (iterations, seconds, Ctrl-C, or a service that cannot be kept up)."""
        started: float | None = None
        asked, start_timeout = 0.0, StartTimeout(self._commanded)
        while not self._stop:
            now = clock.now()
            self._power.look(now)
            for name in [name for name, after in self._late.items() if now - self._commanded >= after]:
                del self._late[name]
                self._start_robot(name)
            for child in self._processes.supervise(now):
                self._note_end(child)
            if self._world.problem:
                self._problems.append(self._world.problem)
                self._stop = True
            for done in self._orders.look():
                self._progress.say(done)
            if now - asked > (ASK_S if started is None else ASK_AGAIN_S):
                asked = now
                self._monitor.ask_status()
            self._progress.pass_on(self._monitor.said(), self._commanded)
            seen = self._monitor.look()
            missing = {name: robot.not_ready(self._services) for name, robot in seen.items()}
            self._progress.show(now, now - self._commanded, seen, missing, self._power.off_now)
            if started is None:
                if self._has_started(seen, missing):
                    started = now
                    self._moves_from = now
                    self._world.move_target(now)
                elif (faults := findings.faults(seen)) and not self._scenario.run_options.drop:
                    self._problems += faults
                    break
                elif not self._late and start_timeout.lost(findings.ready(seen, missing), now):
                    found = findings.obstacles(seen, missing)
                    self._problems.append(f"no first iteration, and nothing new for {START_LIMIT_S:g} s: {found}")
                    break
            else:
                while self._disturbances and now - started >= (self._disturbances[0].at or 0.0):
                    self._let_happen(self._disturbances.pop(0), now)
                if self._is_done(seen, now - started):
                    break
            time.sleep(TICK_S)
        return self._outcome(started)

    def _note_end(self, child: Child) -> None:
        """Note a process that is given up. The run ends with it, unless it is that of another app: of one beside, or of
        one that somebody has started."""
        # An app has named its fault on the bus; else the end of the log is all there is.
        reason = "" if child.exit_code == APP_FAULT else f": {child.last_words()}"
        words = f"{child.robot} {child.service} {child.given_up}{reason}"
        if child.service in (*self._services, RADIO):
            self._problems.append(words)
            self._stop = True
            return
        for each in words.splitlines():
            self._progress.say(each)
        if child.service in self._beside:
            self._problems.append(f"{child.robot} {child.service} {child.given_up}: {child.last_words()}")

    def _start_robot(self, name: str) -> None:
        directory = self._run_dir / name
        for service, module in SERVICE_MODULES.items():
            self._processes.add(name, service, [module], directory)
        if self._scenario.app is not None and self._scenario.program is not None:
            words = [APP_SERVICE, self._scenario.program, *self._scenario.run_options.arguments]
            self._processes.add(name, f"app/{self._scenario.app}", words, directory)
        for service, beside in self._beside.items():
            words = [APP_SERVICE, beside.program, *self._scenario.run_options_beside.arguments]
            self._processes.add(name, service, words, directory)

    def _start_app(self, robot: str, app: str, settings: Sequence[str]) -> None:
        """Start one of the built-in apps on request."""
        words = [word for setting in settings for word in ("--set", setting)]
        self._processes.add(robot, f"app/{app}", [APP_SERVICE, app, *words], self._run_dir / robot)

    def _environment(self, run: str) -> dict[str, str]:
        options = self._options
        link = {
            "latency": options.latency,
            "jitter": options.jitter,
            "bandwidth": options.bandwidth,
            "loss": options.loss,
            "seed": options.seed,
        }
        return {
            "SWARM_CONFIG": str(self._run_dir / "swarm.toml"),
            "SWARM_RECORD": str(self._records),
            "SWARM_RUN": run,  # frames of another run, should one still be about, are told apart by it
            "SWARM_SEED": str(options.seed),
            "SWARM_SIM_LYING": self._scenario.lying or "",
            "SWARM_SIM_LINK": ",".join(f"{name}={value}" for name, value in link.items() if value is not None),
        }

    def _has_started(self, seen: Mapping[str, Seen], missing: Mapping[str, Sequence[str]]) -> bool:
        """Return whether all robots have begun that do not come late, or all where all do."""
        late = self._scenario.late
        present = {name: robot for name, robot in seen.items() if name not in late} or dict(seen)
        ready = bool(present) and not any(missing[name] for name in present)
        if self._scenario.app is None:
            return ready
        if not self._scenario.steps:  # it may wait for a button, or a message, for ever
            return ready and all(
                robot.progress is not None and robot.progress.phase == "running" for robot in present.values()
            )
        return bool(present) and all(
            findings.iteration(robot) >= 1 or findings.failed(robot) for robot in present.values()
        )

    def _is_done(self, seen: Mapping[str, Seen], elapsed: float) -> bool:
        faults = findings.faults(seen)
        if faults and not self._scenario.run_options.drop:
            self._problems += faults
            return True
        if self._options.seconds is not None:
            return elapsed >= self._options.seconds
        if self._scenario.app is None:
            return False
        members = findings.members(seen)  # robots that the others go on without are waited for no more
        told = [progress for name in members if (progress := seen[name].progress) is not None]
        if len(told) < len(members) or any(progress.phase not in ("done", "fault") for progress in told):
            return False
        self._problems += faults  # the others have gone on without them
        self._problems += dict.fromkeys(each.reason for each in told if each.phase == "done" and is_unmet(each.reason))
        return True

    def _let_happen(self, what: Disturbance, now: float) -> None:
        self._progress.say(str(what))
        try:
            self._do(what, now)
        except LocalError as error:
            self._impossible.append(f"{what}: {error}")
            self._progress.say(f"warning: {self._impossible[-1]}")

    def _do(self, what: Disturbance, now: float) -> None:
        """Cause a disturbance. Raises `LocalError` where it is not possible at this moment."""
        match what:
            case Cut(a, b, _, seconds):
                cut_link(self._run_dir, a, b, seconds)
            case Off(robot, _, seconds) if robot in self._late:
                self._late[robot] = max(self._late[robot], now - self._commanded + seconds)
            case Off(robot, _, seconds):
                self._power.off(robot, now, seconds)
            case Kill(robot) | ScheduledPress(robot) | ScheduledPush(robot) if (
                robot in self._late or self._power.is_off(robot)
            ):
                raise LocalError(SWITCHED_OFF)
            case Kill(robot, service):
                if not self._processes.end(robot, f"app/{self._scenario.app}" if service == "app" else service):
                    raise LocalError(NOT_RUNNING)
            case ScheduledPress(robot, button):
                datagrams.send_action(self._run_dir / robot, actions.Press(button, PRESS_S))
            case ScheduledPush(robot, _, impulse):
                datagrams.send_action(self._run_dir / robot, actions.Push(impulse))

    def _refresh(self, now: float) -> None:
        """Wait for every mesh's counters as they are at the end. Of a mesh that does not answer the last ones hold."""
        self._monitor.ask_status()
        while clock.now() < now + REFRESH_LIMIT_S:
            seen = self._monitor.look()
            if all("mesh" in robot.status and robot.status["mesh"].t >= now for robot in seen.values()):
                return
            time.sleep(TICK_S)

    def _interrupted(self, number: int, _: object) -> None:
        self._signal, self._stop = number, True

    def _trajectories(self, app: str) -> dict[str, trajectory.Trajectory]:
        """Return the trajectories by robot. They are whole only where another run is compared: those of a day take
        gigabytes."""
        whole = bool(self._scenario.recorded)
        names = self._scenario.config.names
        return {name: trajectory.read(self._records / f"{name}.{app}{SUFFIX}", whole=whole) for name in names}

    def _outcome(self, started: float | None) -> RunOutcome:
        names = self._scenario.config.names
        now = clock.now()
        absent = [each for each in self._scenario.disturbances if each.at is None and each.robot in self._late]
        left = [*absent, *self._disturbances]
        self._refresh(now)
        seen = self._monitor.look()
        if self._options.seconds is not None:
            self._problems += findings.held_up(seen)
        self._problems += unrecorded(seen)
        memory = {name: footprint.resident_mib(self._processes.of(name)) for name in names}
        found = self._world.look(
            lambda record, contacts: scene.seen(self._scenario, record, contacts, self._commanded, started)
        )
        self._processes.stop()  # only then are the recordings complete
        self._progress.pass_on(self._monitor.said(), self._commanded)  # lines without an end come last
        late = {}
        with contextlib.suppress(OSError, ValueError):  # it has ended in another way
            late = json.loads((self._run_dir / RADIO / LATENESS).read_text())
        paths = self._trajectories(self._scenario.app) if self._scenario.app is not None else {}
        beside = {each.app: self._trajectories(each.app) for each in self._beside.values()}
        firsts = [path.first_reached() for name, path in paths.items() if name not in self._scenario.late]
        reached = [at for at in firsts if at is not None]
        if reached and len(reached) == len(firsts):
            started = max(reached)
        return RunOutcome(
            scenario=self._scenario,
            seed=self._options.seed,
            started_s=None if started is None else started - self._commanded,
            seconds=0.0 if started is None else now - started,
            trajectories=paths,
            bodies={name: seen[name].balancer for name in names},
            messages=findings.messages(seen),
            rss_mib=memory,
            restarts={
                name: self._power.cycles[name] + sum(child.restarts for child in self._processes.of(name))
                for name in names
            },
            problems=tuple(self._problems),
            missing=tuple(name for name in names if name not in findings.members(seen)),
            scene=found,
            moves_from=self._moves_from,
            beside=beside,
            radio=late,
            ended_by=self._signal,
            never=(*self._impossible, *never(left, 0.0 if started is None else now - started)),
        )
