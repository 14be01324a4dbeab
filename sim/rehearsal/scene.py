"""The swarm an app is rehearsed with: robots on the thesis' table, starting values that differ, a measurement."""

import math
from collections.abc import Mapping
from dataclasses import replace

from services.apps.loader import LoadedApp
from sim.core.module_line import module_address
from sim.scenario.scenario import START_VALUES, first_place, on_table
from swarm.app.sync_app import BaseApp as AnyApp
from swarm.config import AppConfig, Config, RobotConfig, SimulationConfig
from swarm.core.graph import Graph
from swarm.errors import AppError
from swarm.messages import Measurement
from swarm.messages.codec import Value

TARGET = (0.5, 1.0)
"""Place of the target in the thesis' figure 4.8, m."""

STARTS = START_VALUES[6]
"""First values of shared floats whose class gives none."""


def rehearsal_config(
    app: LoadedApp,
    robots: int,
    topology: str,
    parameters: Mapping[str, Value] | None = None,
    values: Mapping[str, Mapping[str, Value]] | None = None,
) -> Config:
    """Return the configuration; `parameters` hold for all robots, `values` for single ones by name."""
    names = [f"r{i}" for i in range(robots)]
    for name in values or {}:
        if name not in names:
            raise AppError(f"values of {name}: the robots are {', '.join(names)}")
    common = dict(parameters or {})
    own: dict[str, dict[str, Value]] = {name: dict((values or {}).get(name, {})) for name in names}
    kind, _ = app.choose({name: value for name, value in common.items() if name == "algorithm"})
    for field in _without_start(kind):
        if field not in common and not any(field in given for given in own.values()):
            for index, name in enumerate(names):
                own[name][field] = STARTS[index] if index < len(STARTS) else float(index)
    return replace(
        on_table("rehearsal", names, Graph.of_shape(topology, names).edges),
        robots=tuple(
            RobotConfig(name, link=f"sim:{name}", uwb=module_address(index)) for index, name in enumerate(names)
        ),
        simulation=SimulationConfig(
            target=TARGET, places={name: (*first_place(index), 0.0) for index, name in enumerate(names)}
        ),
        apps={app.name: AppConfig(common, own)},
    )


def measurement(name: str, k: int) -> Measurement:
    """Return the exact range to the target and the robot's own place at step k; there are ten steps a second."""
    here = first_place(int(name[1:]))
    return Measurement(0.1 * k, k, math.dist(here, TARGET), *here)


def _without_start(kind: type[AnyApp]) -> list[str]:
    """Return the shared floats to which the class gives no first value and no parameter."""
    spec = kind.spec
    return [
        field.name
        for field in spec.schema.fields
        if field.kind in ("float", "float32") and not hasattr(kind, field.name) and field.name not in spec.parameters
    ]
