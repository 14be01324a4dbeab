"""A rehearsal of one event-driven or periodic app."""

from services.apps import loader
from services.apps.equipment.speaker import prints_heard
from sim.rehearsal.rehearsal import Rehearsal, Said
from sim.virtual.world import MakeRunner
from swarm.app.event_app import EventApp
from swarm.config import Config
from swarm.errors import AppError, LocalError

LATENCY = 0.03
"""Seconds that a message takes to a neighbour."""


class EventRehearsal(Rehearsal):
    """Runs an app on all robots of a configuration."""

    def __init__(
        self, app: loader.LoadedApp, config: Config, runner: MakeRunner | None = None, said: Said | None = None
    ) -> None:
        """`runner(app, source)` makes what calls the app's handlers, in place of an `EventRunner`. `said(robot, line)`
        is called with what apps print and log."""
        kind = app.kind_on(config, config.names[0])
        if not issubclass(kind, EventApp):
            raise AppError(f"{app.source}: {kind.__name__} is no EventApp or PeriodicApp")
        super().__init__(app, config, LATENCY, runner=runner, said=said)

    @prints_heard()
    def run(self, until: float) -> None:
        """Let time pass until `until`, s since the start. Raises `AppError` where the app of a robot has failed, and
        `LocalError` for a time that is over, or is now."""
        if not until > self.now:
            raise LocalError(f"run: expected a time since the start, of more than {self.now:g} s; got {until!r}")
        self._pass(until)
