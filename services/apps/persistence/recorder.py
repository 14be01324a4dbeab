"""The records of an app host: one MCAP file for each robot and app (docs/reference/recordings.md)."""

from collections.abc import Mapping
from typing import Protocol

from services.apps.host.observer import Source, StepRecord
from swarm.app.sync_app import BaseApp
from swarm.core.state import shape_text
from swarm.messages import AppEpoch, AppLog, AppParameters, AppProgress, Measurement
from swarm.messages.codec import Value
from swarm.messages.keys import key
from swarm.recording.reader import MEMBERS, PLOTTED, SHAPES


class Sink(Protocol):
    """A destination of messages: a `RecordingFile`, or in virtual time a `DirectRecording`."""

    def metadata(self, name: str, entries: Mapping[str, str]) -> None:
        """Note something about the whole recording."""

    def write(self, topic: str, t: float, message: object, name: str = "") -> None:
        """Take a message recorded at `t`; `name` is what its schema is called."""

    def flush(self) -> None:
        """Put into the file what was written so far."""


def describe_fields(sink: Sink, app: str, kind: type[BaseApp]) -> None:
    """Note what a reader has to know of the fields of an app's class, and what its author wants to be drawn."""
    schema = kind.spec.schema
    if schema.shapes:
        sink.metadata(SHAPES, schema.shapes)
    if schema.members:
        sink.metadata(MEMBERS, {f"{app}.{name}": text for name, text in schema.members.items()})
    if kind.plotted:
        sink.metadata(PLOTTED, {app: " ".join(kind.plotted)})


class Recorder:
    """The recording of one app on one robot, under the keys that its messages have on the bus."""

    def __init__(self, sink: Sink, robot: str, app: str) -> None:
        self._sink = sink
        self._prefix = key(robot, f"app/{app}")
        self._app = app
        self._shaped = False

    def advanced(self, source: Source, line: StepRecord) -> None:
        if not self._shaped and not source.part:  # with the first result its shapes are known
            self._shaped = True
            if shapes := source.runner.shapes:
                self._sink.metadata(SHAPES, {name: shape_text(shape) for name, shape in shapes.items()})
        if line.measurement is not None:
            self.measurement(line.k - 1, line.t, line.measurement)
        self.state(line.k, line.t, line.state, line.result, source.part)

    def progressed(self, source: Source) -> None:
        self.progress(source.progress, source.part)

    def ended(self, source: Source) -> None:
        self.progressed(source)

    def switched(self, source: Source, epoch: AppEpoch) -> None:
        self.epoch(epoch, source.part)
        self.progressed(source)

    def state(
        self, k: int, t: float, state: Mapping[str, Value], result: Mapping[str, Value], channel: str = ""
    ) -> None:
        """Record iteration k, reached at t; of one of the app's channels where it is named."""
        topic, name = self._topic(channel, "state")
        # The fields of an `AppState`: of each iteration, and a mapping is written in half the time.
        self._sink.write(topic, t, {"t": t, "k": k, "state": state, "result": result}, name)

    def progress(self, progress: AppProgress, channel: str = "") -> None:
        """Record that the app waits, goes on, is done or in fault. At the end what was recorded is in the file when
        this returns: whoever hears of the end finds it there."""
        topic, _ = self._topic(channel, "progress")
        self._sink.write(topic, progress.t, progress)
        if progress.phase in ("done", "fault"):
            self._sink.flush()

    def parameters(self, robot: str, parameters: AppParameters) -> None:
        self._sink.write(f"{self._prefix}/parameters", parameters.t, parameters)

    def epoch(self, epoch: AppEpoch, channel: str = "") -> None:
        """Record that the members have changed: what was recorded of its first iteration and later ones is void, they
        are done again with other members."""
        topic, _ = self._topic(channel, "epoch")
        self._sink.write(topic, epoch.t, epoch)

    def measurement(self, k: int, t: float, it: Measurement) -> None:
        """Record what step k computed with, which gives state k + 1."""
        fields = {"t": t, "k": k, "distance": it.distance, "x": it.x, "y": it.y}
        self._sink.write(f"{self._prefix}/measurement", t, fields, "swarm.Measurement")

    def value(self, name: str, t: float, value: object) -> None:
        """Record what the app's author wants kept (`robot.record`)."""
        self._sink.write(f"{self._prefix}/record/{name}", t, {"t": t, "value": value}, f"{self._app}.{name}")

    def said(self, line: AppLog) -> None:
        """Record what the app has printed or logged."""
        self._sink.write(f"{self._prefix}/log", line.t, line)

    def _topic(self, channel: str, what: str) -> tuple[str, str]:
        """Topic and schema name."""
        parts = [channel, what] if channel else [what]
        return "/".join((self._prefix, *parts)), ".".join((self._app, *parts))
