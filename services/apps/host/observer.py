"""The interface of listeners to an app's iterations, steps and events: its recording, or a run under virtual time."""

from collections.abc import Mapping
from typing import NamedTuple, Protocol

from services.apps.runner import AppRunner
from swarm.messages import AppEpoch, AppParameters, AppProgress, Measurement
from swarm.messages.codec import Value


class StepRecord(NamedTuple):
    """One iteration, step or event of an app on one robot, and what it has come to."""

    k: int
    t: float
    """The time at which it was done, s by the robot's clock."""
    state: dict[str, Value]
    result: Mapping[str, Value]
    measurement: Measurement | None = None
    """What the step that gave this state computed with."""


class Source(Protocol):
    """The part of an app that an observer hears: the driver of a lockstep, or the host of an event-driven app."""

    @property
    def robot(self) -> str:
        """The robot that it runs on."""

    @property
    def app(self) -> str:
        """The app's name."""

    @property
    def part(self) -> str:
        """The name of the channel within the app; empty for the app itself."""

    @property
    def runner(self) -> AppRunner:
        """Return the runner of the app."""

    @property
    def progress(self) -> AppProgress:
        """Return the progress, and what holds it up."""


class Observer(Protocol):
    """A listener to the iterations of an app."""

    def advanced(self, source: Source, line: StepRecord) -> None:
        """The app has done an iteration, a step or an event."""

    def progressed(self, source: Source) -> None:
        """The app has begun, waits for others than before, or goes on."""

    def ended(self, source: Source) -> None:
        """The app is done, or has failed."""

    def switched(self, source: Source, epoch: AppEpoch) -> None:
        """The members have changed: the iterations from the epoch's first one on are done again."""

    def parameters(self, robot: str, parameters: AppParameters) -> None:
        """These parameters of the app are in force on a robot from now on."""
