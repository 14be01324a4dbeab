"""Configuration of the swarm: one `swarm.toml`, the same on every robot."""

from swarm.config.dump import dump
from swarm.config.load import load, parse, who_am_i
from swarm.config.types import (
    DEFAULT_RELAY,
    Affine,
    Anchor,
    AppConfig,
    Balancing,
    Body,
    Config,
    Dwm,
    Linear,
    MeshConfig,
    RelayRule,
    RobotConfig,
    SimulationConfig,
)

__all__ = [
    "DEFAULT_RELAY",
    "Affine",
    "Anchor",
    "AppConfig",
    "Balancing",
    "Body",
    "Config",
    "Dwm",
    "Linear",
    "MeshConfig",
    "RelayRule",
    "RobotConfig",
    "SimulationConfig",
    "dump",
    "load",
    "parse",
    "who_am_i",
]
