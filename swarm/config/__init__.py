"""Configuration of the swarm: one `swarm.toml`, the same on every robot."""

from swarm.config.load import load, parse, who_am_i
from swarm.config.types import (
    Affine,
    Anchor,
    App,
    Body,
    Config,
    Dwm,
    Linear,
    Mesh,
    RelayRule,
    Robot,
    Simulation,
)

__all__ = [
    "Affine",
    "Anchor",
    "App",
    "Body",
    "Config",
    "Dwm",
    "Linear",
    "Mesh",
    "RelayRule",
    "Robot",
    "Simulation",
    "load",
    "parse",
    "who_am_i",
]
