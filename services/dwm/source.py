"""Where the measurements come from, as `[dwm] source` of swarm.toml says it."""

from pathlib import Path

from swarm.config import Config
from swarm.errors import ConfigError
from swarm.frozen import frozen


@frozen
class Serial:
    """`serial:PATH`: a DWM1001 in generic mode at a serial port."""

    path: Path


@frozen
class Replay:
    """`replay:DIR`: a folder of recordings, one file for each robot by its number in the config."""

    directory: Path


@frozen
class BalancerSource:
    """`balancer`: the DWM1001 is wired to the ATmega32U4, which polls it; its reports come from the balancer."""


@frozen
class BusSource:
    """`bus:KEY`: another process on the robot's bus gives poses or ranges, as a motion capture system."""

    key: str


def parse_source(config: Config, robot: str) -> Serial | Replay | BalancerSource | BusSource:
    """The source of `robot`; `{robot}` stands for its name; a relative path starts at the config's folder."""
    text = config.dwm.source
    if text == "balancer":
        return BalancerSource()
    kind, _, rest = text.partition(":")
    path = config.path.parent / rest.replace("{robot}", robot)
    if rest and kind == "serial":
        return Serial(path)
    if rest and kind == "replay":
        return Replay(path)
    if rest and kind == "bus":
        return BusSource(rest.replace("{robot}", robot))
    raise ConfigError(
        f"{config.path}: [dwm] source: expected serial:PATH, balancer, bus:KEY or replay:DIR, got {text!r}"
    )
