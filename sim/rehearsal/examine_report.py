"""The task of an examination, what it found on one graph, and what all kinds of apps have in common."""

import sys
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial

from services.apps import loader
from sim.rehearsal.limits import Stopwatch, limited
from sim.rehearsal.scene import rehearsal_config
from swarm.app import settings
from swarm.app.settings import Setting
from swarm.app.sync_app import BaseApp as AnyApp
from swarm.config import Config
from swarm.frozen import frozen
from swarm.messages import AppLog

YES, NO, UNASKED = "yes", "no", "not asked for"
"""Words for whether the app has had poses, or ranges, in the rehearsal."""


@frozen
class Task:
    """The app to examine, and how."""

    app: loader.LoadedApp
    robots: int = 6
    iterations: int = 300
    settings: Sequence[Setting] = ()

    @property
    def kind(self) -> type[AnyApp]:
        """Return the class that runs."""
        chosen = {one.name: one.value for one in self.settings if one.name == "algorithm"}
        return self.app.choose(chosen)[0]

    def config(self, graph: str) -> Config:
        """Return the configuration of the swarm on one graph."""
        return rehearsal_config(self.app, self.robots, graph, *settings.common_and_single(self.settings))


@dataclass
class GraphFinding:
    """The findings on one graph."""

    graph: str
    fault: str = ""
    line: int | None = None
    warnings: list[str] = field(default_factory=list)
    seconds: float = 0.0
    """Seconds of virtual time that the app was given."""
    last: bool = False
    """Whether the app hangs or mostly waits: each other graph would take as long again to say the same."""
    iterations: int = 0
    """Steps of the robot that has done the fewest; events, where the app has no steps."""
    poses: str = UNASKED
    ranges: str = UNASKED
    step_mean: float = 0.0
    """Mean CPU time of a step on this machine, s."""
    trend: dict[str, object] = field(default_factory=dict)
    """See `trends.judge`."""
    digests: list[int] = field(default_factory=list)
    """Checksum of all robots' states, by iteration: must be the same in another process."""

    def note(self, apps: Sequence[AnyApp], times: Sequence[float]) -> None:
        """Note whether robots that asked for poses, and for ranges, have some, and the mean of the steps' CPU times."""
        poses, ranges = [], []
        for app in apps:
            devices, ranging = app.robot.devices, app.robot.ranging
            if devices is not None and devices.asked("pose"):
                poses.append(devices.pose is not None)
            if ranging is not None and ranging.listening:
                ranges.append(bool(ranging.ranges))
            if getattr(type(app), "measured", False):
                ranges.append(app.robot.measurement is not None)
        self.poses, self.ranges = _said(poses), _said(ranges)
        if times:
            self.step_mean = sum(times) / len(times)


def make_all(app: loader.LoadedApp, config: Config) -> None:
    """Make the app of each robot. Raises `Hang` for one that takes too long."""
    app.check(config, lambda config, name: limited(app.source, partial(app.make, config, name)))


def _said(there: Sequence[bool]) -> str:
    return UNASKED if not there else YES if all(there) else NO


def cut_short(finding: GraphFinding, watch: Stopwatch, done: str) -> None:
    finding.last = watch.waited > watch.computed
    rest = f" ({watch.waited:.2g} s of it waiting); no other graph is tried" if finding.last else ""
    finding.warnings.append(f"graph {finding.graph}: broken off after {watch.spent}: {done}{rest}")


def digest(states: list[bytes]) -> int:
    return zlib.crc32(b"".join(states))


def write_line(robot: str, line: AppLog) -> None:
    """Write a line of an app to standard error. Of a process that has ended `swarm check` shows the last such line."""
    sys.stderr.write(f"{line.text}\n")
    sys.stderr.flush()
