"""Configuration of the swarm: one `swarm.toml`, the same on every robot."""

from swarm.config.dump import dump
from swarm.config.load import load, parse, who_am_i
from swarm.config.types import (
    DEFAULT_RELAY,
    Affine,
    Anchor,
    App,
    Balancing,
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
    "DEFAULT_RELAY",
    "Affine",
    "Anchor",
    "App",
    "Balancing",
    "Body",
    "Config",
    "Dwm",
    "Linear",
    "Mesh",
    "RelayRule",
    "Robot",
    "Simulation",
    "dump",
    "load",
    "parse",
    "who_am_i",
]
