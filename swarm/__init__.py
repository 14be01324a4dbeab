"""Balboa Swarm: distributed algorithms on swarms of self-balancing robots.

An app author needs `from swarm import SyncApp` (or `EventApp`, `PeriodicApp`, `channel`) and, for some, `parameter`,
`float32`, `Array`, `Vector`, `Matrix`. They are looked up when first asked for, so that services which run no app do
not pay for them.

`simulate`, `sweep`, `load` and `rehearse` are for programs and notebooks on a laptop: they are looked up in what robots
do not carry.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from laptop.runs.results import load
    from laptop.runs.simulation import simulate
    from laptop.runs.sweep import sweep
    from sim.rehearsal import rehearse
    from swarm.app.event_app import EventApp, PeriodicApp, channel
    from swarm.app.parameters import parameter
    from swarm.app.sync_app import SyncApp
    from swarm.core.arrays import Array, float32
    from swarm.core.state import Matrix, Vector

__version__ = "0.1.0"

__all__ = [
    "Array", "EventApp", "Matrix", "PeriodicApp", "SyncApp", "Vector", "__version__", "channel", "float32", "load",
    "parameter", "rehearse", "simulate", "sweep",
]  # fmt: skip

_HOME = {
    "SyncApp": "swarm.app.sync_app",
    "EventApp": "swarm.app.event_app",
    "PeriodicApp": "swarm.app.event_app",
    "channel": "swarm.app.event_app",
    "parameter": "swarm.app.parameters",
    "Array": "swarm.core.arrays",
    "Matrix": "swarm.core.state",
    "Vector": "swarm.core.state",
    "float32": "swarm.core.arrays",
}

_LAPTOP = {
    "load": "laptop.runs.results",
    "rehearse": "sim.rehearsal",
    "simulate": "laptop.runs.simulation",
    "sweep": "laptop.runs.sweep",
}
"""The one way upwards (a contract in pyproject.toml): what an author imports comes from one place."""


def __getattr__(name: str) -> object:
    if name in _HOME:
        return getattr(import_module(_HOME[name]), name)
    if name in _LAPTOP:
        from swarm.packages import check_found  # not above: robots need nothing of it

        try:
            check_found()
            return getattr(import_module(_LAPTOP[name]), name)
        except ModuleNotFoundError as error:
            if error.name not in ("laptop", "sim"):
                raise
            raise ImportError(f"swarm.{name} is for a laptop: robots carry no simulation") from None
    raise AttributeError(f"module 'swarm' has no attribute {name!r}")
