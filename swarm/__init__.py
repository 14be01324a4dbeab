"""Balboa Swarm: distributed algorithms on swarms of self-balancing robots.

An app author needs `from swarm import SyncApp` (or `EventApp`, `PeriodicApp`, `channel`) and, for some, `parameter`,
`float32`, `Vector`, `Matrix`. They are looked up when first asked for, so that services which run no app do not pay for
them.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from swarm.app.event_app import EventApp, PeriodicApp, channel
    from swarm.app.parameters import parameter
    from swarm.app.sync_app import SyncApp
    from swarm.core.state import Matrix, Vector, float32

__version__ = "0.1.0"

__all__ = [
    "EventApp", "Matrix", "PeriodicApp", "SyncApp", "Vector", "__version__", "channel", "float32", "parameter",
]  # fmt: skip

_HOME = {
    "SyncApp": "swarm.app.sync_app",
    "EventApp": "swarm.app.event_app",
    "PeriodicApp": "swarm.app.event_app",
    "channel": "swarm.app.event_app",
    "parameter": "swarm.app.parameters",
    "Matrix": "swarm.core.state",
    "Vector": "swarm.core.state",
    "float32": "swarm.core.state",
}


def __getattr__(name: str) -> object:
    if name in _HOME:
        return getattr(import_module(_HOME[name]), name)
    raise AttributeError(f"module 'swarm' has no attribute {name!r}")
