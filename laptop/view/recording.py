"""What a recorded run shows at any instant of it."""

from bisect import bisect_right
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from laptop.view.feed import config_of
from laptop.view.history import HISTORY_S
from laptop.view.picture import TRAIL_S, Event, Picture, places
from swarm.errors import RecordingError, SwarmError
from swarm.messages.json_values import json_value
from swarm.messages.keys import parse as parse_key
from swarm.recording.core import json_text
from swarm.recording.run import Run

JUMP_S = 3.0
"""A page that goes further than this at once does not play, it jumps."""


class ViewedRecording:
    """A run, all of it in memory: its messages as they were written, JSON text."""

    kind = "recording"

    def __init__(self, path: Path) -> None:
        """Raises `RecordingError` where there is none. What of it cannot be read is named in `damage`."""
        run = Run(path)
        self.path = path
        self.first, self.last = 0.0, 0.0
        """Of its messages, s; 0 is the first iteration."""
        self._rows: dict[str, dict[str, tuple[list[float], list[bytes]]]] = {}
        self._events: list[Event] = []
        teller = Picture()
        for sample in run.samples():
            try:
                robot, service, topic = parse_key(sample.topic)
                message = json_value(sample.message)
            except SwarmError:
                continue
            name = f"{service}/{topic}"
            times, data = self._rows.setdefault(robot, {}).setdefault(name, ([], []))
            times.append(sample.t)
            data.append(sample.data)
            self.first, self.last = min(self.first, sample.t), max(self.last, sample.t)
            teller.put(robot, name, message, sample.t)
            self._events += teller.events
            teller.events.clear()
        self.damage = list(run.damage)
        self.config = config_of(path)
        """Of the run; None where it was not kept or is of another version."""
        self.robots = run.robots

    def step(self, since: float | None, t: float) -> dict[str, Any]:
        """What a page that shows the instant `since` (None: nothing yet) needs to show the instant `t`, s."""
        if since is not None and not since <= t <= since + JUMP_S:
            since = None  # with the trails of that instant: the way between is not drawn
        robots: dict[str, dict[str, object]] = {}
        for robot, topics in self._rows.items():
            new = {}
            for topic, (times, data) in topics.items():
                index = bisect_right(times, t)
                if index > (0 if since is None else bisect_right(times, since)):
                    new[topic] = self._message(data[index - 1])
            if new:
                robots[robot] = new
        events = [event for event in self._events if (since is None or event.t > since) and event.t <= t]
        step: dict[str, Any] = {"t": t, "live": True, "fresh": since is None, "robots": robots}
        if events:
            step["events"] = [event._asdict() for event in events]
        if since is None:
            step["trails"] = {robot: list(self._trail(robot, t)) for robot in self._rows}
        return step

    def history(self, robot: str, topic: str, t: float) -> list[tuple[float, object]]:
        """What a key held in the two minutes before an instant."""
        return list(self._between(robot, topic, t - HISTORY_S, t))

    def _trail(self, robot: str, t: float) -> Iterator[tuple[float, float]]:
        topic = "sim/truth" if "sim/truth" in self._rows[robot] else "dwm/pose"
        return places(self._between(robot, topic, t - TRAIL_S, t), t - TRAIL_S)

    def _between(self, robot: str, topic: str, since: float, t: float) -> Iterator[tuple[float, object]]:
        times, data = self._rows.get(robot, {}).get(topic, ([], []))
        for index in range(bisect_right(times, since), bisect_right(times, t)):
            yield times[index], self._message(data[index])

    def _message(self, data: bytes) -> object:
        try:
            return json_value(json_text.decode(data))
        except (ValueError, RecursionError) as error:
            raise RecordingError(f"{self.path}: a message is not JSON: {error}") from None
