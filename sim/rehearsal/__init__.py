"""Rehearse an app before any robot moves: all robots in one process, without links and without real time.

from sim.rehearsal import rehearse

swarm = rehearse("my_app.py", robots=6, topology="loop", values={"r0": {"value": 5.0}})
swarm.run(100)                          # iterations; of an event-driven or periodic app: until this time, s
swarm.result("r0")["value"]
"""

from collections.abc import Mapping
from pathlib import Path

from services.apps import loader
from sim.rehearsal.events import EventRehearsal
from sim.rehearsal.scene import scene
from sim.rehearsal.sync import SyncRehearsal
from swarm.app.sync_app import SyncApp
from swarm.messages.codec import Value

__all__ = ["EventRehearsal", "SyncRehearsal", "rehearse"]


def rehearse(
    app: str | Path,
    *,
    robots: int = 6,
    topology: str = "line",
    parameters: Mapping[str, Value] | None = None,
    values: Mapping[str, Mapping[str, Value]] | None = None,
) -> SyncRehearsal | EventRehearsal:
    """A swarm that runs `app`, a file or a built-in name, at its start.

    `parameters` and first values for all robots, `values` for single ones: `{"r2": {"value": 3.0}}`. Shared floats that
    neither these nor the class give a first value begin with the thesis' 0.5, 1, 2, 3, 4, 5. Raises `AppError`.
    """
    found = loader.load(str(app))
    config = scene(found, robots, topology, parameters, values)
    found.check(config)
    kind, _ = found.choose({name: value for name, value in (parameters or {}).items() if name == "algorithm"})
    return SyncRehearsal(found, config) if issubclass(kind, SyncApp) else EventRehearsal(found, config)
