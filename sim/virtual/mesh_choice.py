"""How much of a mesh a virtual run has: as `--mesh` says, or as much as the run needs."""

import re
from pathlib import Path

from services.apps import sources
from services.apps.loader import LoadedApp
from services.mesh.core.routing.physical_links import links_of
from sim.scenario.options import DELAY, FROM_START, SETTLED, Options
from sim.scenario.scenario import Scenario
from swarm.app.sync_app import SyncApp
from swarm.config.types import GRAPH
from swarm.errors import ConfigError

MAX_FROM_START = 50
"""Robots whose mesh is started: the link states of N robots cross each link, which costs as much as N iterations."""

MAX_SETTLED = 200
"""Robots whose mesh is settled, where the run needs no more than delays. Delays take half the computing time."""

_NEEDS_MESH = re.compile(rb"(?<!swarm)\.\s*(flood|send|messages|answer|clock)\b")
"""What the text of an app has that uses more of its mesh than messages to neighbours. `swarm.messages` is a package."""


def mesh_of(options: Options, scenario: Scenario) -> str:
    """Return one of `sim.scenario.options.MESHES`. Raises `ConfigError` where the links do not go with it."""
    config = scenario.config
    mesh = options.mesh or _needed(options, scenario)
    if mesh == DELAY and config.auto:
        raise ConfigError("--mesh delay: an automatic topology is found by meshes, name another --topology")
    if mesh != FROM_START and (links := links_of(config)) != GRAPH:
        raise ConfigError(f"--mesh {mesh}: links = {links!r} are made by meshes from their start")
    return mesh


def _needed(options: Options, scenario: Scenario) -> str:
    robots = len(scenario.config.names)
    if robots <= MAX_FROM_START or scenario.config.auto:
        return FROM_START
    return DELAY if robots > MAX_SETTLED and _delays_do(options, scenario) else SETTLED


def _delays_do(options: Options, scenario: Scenario) -> bool:
    """Return whether states and iteration times are the same without meshes: of one synchronous app that only shares
    its state, on links with one latency. A person at the page may want more of a mesh."""
    app = scenario.loaded
    links_differ = options.slots is not None or options.jitter or options.bandwidth or options.loss
    made_by_meshes = links_of(scenario.config) != GRAPH
    if app is None or scenario.beside or scenario.disturbances or links_differ or made_by_meshes or options.view:
        return False
    synchronous = all(issubclass(kind, SyncApp) for kind in app.algorithms.values())
    texts = _texts(app)
    return synchronous and all(texts) and not any(map(_NEEDS_MESH.search, texts))


def _texts(app: LoadedApp) -> list[bytes]:
    """Return the texts of an app's files; an empty one of a class whose text nobody has kept."""
    path = Path(app.source)
    return list(sources.of_app(path).values()) if path.is_file() else [app.text]
