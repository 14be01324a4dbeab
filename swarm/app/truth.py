"""The truth that only a simulation knows: the places of robots and target. An app's `error(self, truth)` is measured
with it.

On real robots nobody knows, and nothing is measured.
"""

import logging
from collections.abc import Mapping
from typing import cast

from swarm.app.event_app import channels_of
from swarm.app.sync_app import BaseApp
from swarm.bus.protocol import BusLike
from swarm.config import Config
from swarm.errors import PayloadError
from swarm.frozen import frozen
from swarm.messages import Target
from swarm.messages import Truth as TruePose
from swarm.messages.codec import Value, decode
from swarm.messages.keys import key

_log = logging.getLogger("truth")


@frozen
class RobotTruth:
    """The truth for one robot at one moment."""

    x: float
    """The robot's place, m."""
    y: float
    heading: float
    """rad, counter-clockwise from x."""
    target: tuple[float, float]
    """The target's place, m."""
    told: Mapping[str, Mapping[str, Value]]
    """Parameters and first values by robot: those of the configuration and `--set`, else the class's own."""


class TruthWatch:
    """Listens for the truth on one robot's bus, where a simulation tells it (10 times a second)."""

    def __init__(self, bus: BusLike, robot: str, app: str, kind: type[BaseApp], config: Config) -> None:
        self._pose: TruePose | None = None
        self._target = config.simulation.target
        self._told = told(config, app, kind)
        bus.subscribe([key(robot, "sim", "truth"), key(robot, "sim", "target")], self._take)

    def __call__(self) -> RobotTruth | None:
        """Return what the simulation has told so far; None before its first message."""
        pose = self._pose
        return None if pose is None else RobotTruth(pose.x, pose.y, pose.heading, self._target, self._told)

    def _take(self, name: str, payload: bytes) -> None:
        try:
            if name.endswith("/truth"):
                self._pose = decode(TruePose, payload, name)
            else:
                target = decode(Target, payload, name)
                self._target = (target.x, target.y)
        except PayloadError as error:
            _log.debug("%s", error)


def told(config: Config, app: str, kind: type[BaseApp]) -> dict[str, Mapping[str, Value]]:
    """Return by robot the values with which an app of this class begins, before its `start`."""
    known, own = config.app(app), _own_values(kind)
    return {name: {**own, **known.of(name)} for name in config.names}


def _own_values(kind: type[BaseApp]) -> dict[str, Value]:
    """Return the parameters and first values that a class itself gives; those of channels as `CHANNEL_NAME`."""
    found = {name: parameter.default for name, parameter in kind.spec.parameters.items()}
    for field in kind.spec.schema.fields:
        found[field.name] = field.message_value(field.check(getattr(kind, field.name, field.zero)))
    for part, declared in channels_of(kind).items():
        inner = {**_own_values(declared.kind), **cast(Mapping[str, Value], declared.values)}
        found |= {f"{part}_{name}": value for name, value in inner.items()}
    return found
