"""Rehearse an app before any robot moves: all robots in one process, without links and without real time.

from swarm import rehearse

swarm = rehearse("my_app.py", robots=6, topology="loop", values={"value": [5.0, 0, 0, 0, 0, 0]})
swarm.run(100)                          # iterations; of an event-driven or periodic app: until this time, s
swarm.result("r0")["value"]
"""

import sys
from collections.abc import Mapping
from functools import partial
from numbers import Integral
from pathlib import Path
from typing import Any

from services.apps import loader
from sim.processes.progress import say
from sim.rehearsal.events import EventRehearsal
from sim.rehearsal.scene import rehearsal_config
from sim.rehearsal.sync import SyncRehearsal
from sim.scenario.values import settings_from_values
from swarm.app.settings import common_and_single
from swarm.app.sync_app import BaseApp, SyncApp
from swarm.errors import AppError
from swarm.messages.codec import Value

__all__ = ["EventRehearsal", "SyncRehearsal", "rehearse"]


def rehearse(
    app: type[BaseApp] | str | Path,
    *,
    robots: int = 6,
    topology: str = "line",
    parameters: Mapping[str, Value] | None = None,
    values: Mapping[str, Any] | None = None,
) -> SyncRehearsal | EventRehearsal:
    """Return a swarm that runs `app` (a class, a file or a built-in name); a test drives it step by step.

    `parameters` hold for all robots. `values` are parameters and first values as `swarm.simulate` takes them: for all,
    as a list with one for each robot, or by robot, `{"r2": {"value": 3.0}}`. Shared floats that neither these nor the
    class give a first value begin with the thesis' 0.5, 1, 2, 3, 4, 5. What a robot's app prints and logs goes to the
    program's own output, with time and robot. Raises `AppError` for an app that cannot run.
    """
    if not isinstance(robots, Integral) or robots < 1:
        raise AppError(f"robots: expected a whole number above zero, got {robots!r}")
    found = loader.load(str(app)) if isinstance(app, str | Path) else loader.of_class(app)
    kind, _ = found.choose({name: value for name, value in (parameters or {}).items() if name == "algorithm"})
    settings = settings_from_values(kind, values or {}, [f"r{index}" for index in range(robots)])
    common, single = common_and_single(settings)
    config = rehearsal_config(found, robots, topology, {**(parameters or {}), **common}, single)
    found.check(config)
    rehearsal = SyncRehearsal if issubclass(kind, SyncApp) else EventRehearsal
    return rehearsal(found, config, said=partial(say, sys.stdout))
