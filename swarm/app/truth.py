"""The truth that only a simulation knows: the places of robots and target. An app's `error(self, truth)` is measured
with it.

On real robots nobody knows, and nothing is measured.
"""

import logging
from collections.abc import Mapping

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
    """The parameters and first values that the configuration and `--set` give the app, by robot."""


class TruthWatch:
    """Listens for the truth on one robot's bus, where a simulation tells it (10 times a second)."""

    def __init__(self, bus: BusLike, robot: str, app: str, config: Config) -> None:
        self._pose: TruePose | None = None
        self._target = config.simulation.target
        self._told = told(config, app)
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


def told(config: Config, app: str) -> dict[str, Mapping[str, Value]]:
    """Return by robot the values that the configuration gives an app."""
    known = config.app(app)
    return {name: known.of(name) for name in config.names}
