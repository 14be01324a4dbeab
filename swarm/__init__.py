"""Balboa Swarm: distributed algorithms on swarms of self-balancing robots.

An app author needs `from swarm import SyncApp` and, for some, `float32`, `Vector`, `parameter`. They are
looked up when first asked for, so that services which run no app do not pay for them.
"""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from swarm.app import SyncApp, parameter
    from swarm.core.state import Vector, float32

__version__ = "0.1.0"

__all__ = ["SyncApp", "Vector", "__version__", "float32", "parameter"]


def __getattr__(name: str) -> object:
    if name in ("SyncApp", "parameter"):
        from swarm import app

        return getattr(app, name)
    if name in ("Vector", "float32"):
        from swarm.core import state

        return getattr(state, name)
    raise AttributeError(f"module 'swarm' has no attribute {name!r}")
