"""The records of one app under virtual time: its last states or all, and a recording where one is wanted."""

from collections.abc import Collection, Mapping
from functools import partial
from pathlib import Path

from services.apps import loader
from services.apps.host.observer import Source, StepRecord
from services.apps.persistence.recorder import Recorder, describe_fields
from sim.virtual.apps.trajectory_builder import TrajectoryBuilder
from sim.virtual.bus import VirtualBus
from sim.virtual.events import LocalTime
from sim.virtual.world import VirtualWorld
from swarm.messages import AppEpoch, AppParameters
from swarm.recording import folder
from swarm.recording.reader import OUTCOME, SUFFIX, WORLD_CLOCK
from swarm.recording.recorded_topics import TopicRecorder
from swarm.recording.trajectory import Trajectory
from swarm.recording.virtual_file import DirectRecording


class AppRecords:
    """The records of one app on all robots."""

    def __init__(self, world: VirtualWorld, app: str, *, keep: bool, skewed: bool) -> None:
        """`keep`: the states of all iterations, not only the last; `skewed`: each robot has a clock of its own."""
        self.app = app
        self._world = world
        self._skewed = skewed
        self._builders = {name: TrajectoryBuilder(keep=keep) for name in world.robots}
        self._files: list[DirectRecording] = []
        self._recorders: dict[str, Recorder] = {}

    def record(self, place: Path, app: loader.LoadedApp, number: int, topics: Collection[str]) -> None:
        """Begin a recording: one file for all robots, or one for each where each has a clock of its own. `topics`: see
        `TopicRecorder`."""
        world, run = self._world, folder.describe(app.name, number, self._world.seed, app.digest)
        if self._skewed:
            files = {name: DirectRecording(place / f"{name}.{app.name}{SUFFIX}", run, name) for name in world.robots}
            self._files = list(files.values())
            for name, robot in world.robots.items():
                assert isinstance(robot.time, LocalTime)
                files[name].metadata(WORLD_CLOCK, {key: repr(it) for key, it in robot.time.relation.items()})
        else:
            self._files = [DirectRecording(place / f"{app.name}{SUFFIX}", run)]
            files = dict.fromkeys(world.robots, self._files[0])
        kind = app.kind_on(world.config, world.config.names[0])
        for file in self._files:
            describe_fields(file, app.name, kind)
        self._recorders = {name: Recorder(files[name], name, app.name) for name in world.robots}
        for name, recorder in self._recorders.items():
            world.hearers.setdefault((name, app.name), []).append(recorder.said)
        world.records |= {(name, app.name): recorder.value for name, recorder in self._recorders.items()}
        for name, robot in world.robots.items():
            bus = VirtualBus(robot.router)
            now = partial(getattr, robot.time, "now")
            watch = TopicRecorder(bus, name, app.name, files[name], now, topics=topics)
            watch.on_sample = watch.drain
            watch.hear_requests(bus, name)

    def advanced(self, source: Source, line: StepRecord) -> None:
        """Record that a robot has done an iteration."""
        if self._recorders:
            self._recorders[source.robot].advanced(source, line)
        if not source.part:
            self._builders[source.robot].write(source, line._replace(t=self._world.time.now) if self._skewed else line)

    def progressed(self, source: Source) -> None:
        """Record that a robot has begun, waits for others, or goes on."""
        if not source.part and source.progress.phase == "starting":
            self._builders[source.robot].begin_anew()
        if self._recorders:
            self._recorders[source.robot].progressed(source)

    def switched(self, source: Source, epoch: AppEpoch) -> None:
        """Record that the members have changed."""
        if self._recorders:
            self._recorders[source.robot].switched(source, epoch)
        if not source.part:
            self._builders[source.robot].go_back(epoch.k)

    def parameters(self, robot: str, parameters: AppParameters) -> None:
        """Record which parameters are in force on a robot."""
        if self._recorders:
            self._recorders[robot].parameters(robot, parameters)

    def close(self, found: Mapping[str, str]) -> None:
        """End the recording; `found` is what came out of the run."""
        for file in self._files:
            file.metadata(OUTCOME, found)
            file.close()

    def trajectories(self) -> dict[str, Trajectory]:
        """Return the trajectories by robot."""
        return {name: builder.trajectory() for name, builder in self._builders.items()}
