"""The scene of a recorded run, for `swarm export --mcap`: the same topics that `swarm foxglove` serves live."""

import math
from collections.abc import Iterator

from laptop.foxglove import scene
from laptop.foxglove.messages import FoxgloveMessage, frames, log
from laptop.view.feeds.picture import Picture
from swarm.config.types import Config
from swarm.errors import SwarmError
from swarm.messages.json_values import json_value
from swarm.messages.keys import parse
from swarm.recording.reader import RecordedSample

PERIOD = 0.1
"""Seconds between two scenes."""


class RecordedScenes:
    """Makes scenes of a run's samples as they pass in the order of time."""

    def __init__(self, config: Config, epoch_ns: int) -> None:
        """`epoch_ns`: the time of day at which the samples' time is 0, ns since 1970."""
        self._config = config
        self._epoch_ns = epoch_ns
        self._picture = Picture()
        self._last = -math.inf
        self._event = 0

    def after(self, sample: RecordedSample) -> Iterator[FoxgloveMessage]:
        """Yield the messages to show after a sample. Most samples have none, as has one that cannot be read."""
        try:
            robot, service, topic = parse(sample.topic)
            message = json_value(sample.message)
        except SwarmError:
            return
        self._picture.put(robot, f"{service}/{topic}", message, sample.t)
        log_time = self._epoch_ns + round(sample.t * 1e9)
        if events := self._picture.events_since(self._event):
            self._event = events[-1].number
            yield from log(events, log_time)
        if sample.t >= self._last + PERIOD:
            self._last = sample.t
            yield frames(scene.robot_poses(self._picture, self._config), log_time)
            yield scene.scene_update(self._picture, self._config, log_time)
