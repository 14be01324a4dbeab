"""A recorded run as a page shows it, at any instant."""

import math
from bisect import bisect_right
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from laptop.view import series
from laptop.view.feeds.picture import MAX_EVENTS, TRAIL_S, Event, Picture, pose_topic, track
from laptop.view.series import dig
from swarm.errors import LocalError, RecordingError, SwarmError
from swarm.messages.json_values import json_value
from swarm.messages.keys import parse as parse_key
from swarm.recording.core import foxglove, json_text
from swarm.recording.folder import config_in
from swarm.recording.run import Run

LEVELS = ("error", "warning", "info")
MAX_MARKS = 400

SILENT_S = 2.0
"""Seconds without any message after which a robot is shown as gone, if its balancer is recorded: that tells its state
all the time."""
JUMP_S = 3.0
"""Seconds. A page that advances by more than this at once has jumped and does not play."""


class ViewedRecording:
    """A run in memory: all of its messages as they were written, JSON text."""

    kind = "recording"

    def __init__(self, path: Path) -> None:
        """Raises `RecordingError` where there is no recording. `damage` names the parts that cannot be read."""
        run = Run(path)
        self.path = path
        self.first, self.last = 0.0, 0.0
        """Times of the first and the last message, s; 0 is the first iteration."""
        self._rows: dict[str, dict[str, tuple[list[float], list[bytes]]]] = {}
        self._events: list[Event] = []
        teller = Picture()
        for sample in run.samples():
            try:
                robot, service, topic = parse_key(sample.topic)
                message = self._decoded(sample.data)
            except SwarmError:
                continue
            if not isinstance(message, dict):
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
        self.config = config_in(path)
        """The run's configuration; None if it was not kept or is of another version."""
        self.robots = run.robots

    def step(self, since: float | None, t: float) -> dict[str, Any]:
        """Return what a page that shows the instant `since` (None: nothing yet) needs to show the instant `t`, s."""
        if since is not None and not since <= t <= since + JUMP_S:
            since = None  # the page has jumped: it gets the trails of that instant, and the way between is not drawn
        robots: dict[str, dict[str, object]] = {}
        for robot, topics in self._rows.items():
            new = {}
            for topic, (times, data) in topics.items():
                index = bisect_right(times, t)
                if index > (0 if since is None else bisect_right(times, since)):
                    value = self._message(data[index - 1])
                    if topic == "dwm/pose" and isinstance(value, dict):
                        value = {field: each for field, each in value.items() if field not in foxglove.VIEW}
                    new[topic] = value
            if new:
                robots[robot] = new
        # After a jump only the last events are told: a page keeps no more.
        events = [event for event in self._events if (since is None or event.t > since) and event.t <= t][-MAX_EVENTS:]
        step: dict[str, Any] = {"t": t, "live": True, "fresh": since is None, "robots": robots}
        step["services"] = {robot: {"balancer": False} for robot in self._rows if self._is_gone(robot, t)}
        if events:
            step["events"] = [event._asdict() for event in events]
        if since is None:
            step["trails"] = {robot: list(self._trail(robot, t)) for robot in self._rows}
        return step

    def _is_gone(self, robot: str, t: float) -> bool:
        """Return whether a robot is silent at an instant: it is switched off, or has not come yet."""
        topics = self._rows[robot]
        if "balancer/state" not in topics:
            return False
        told = [times for topic, (times, _) in topics.items() if not topic.startswith("sim/")]  # not by its processes
        indices = ((times, bisect_right(times, t)) for times in told)
        return t - max((times[index - 1] for times, index in indices if index), default=self.first) > SILENT_S

    def series(self, topic: str, fields: Sequence[series.Path]) -> dict[str, list[series.Row]]:
        """Return numbers of a key over the whole run, by robot."""
        found, most = {}, series.most_of(len(self._rows))
        for robot, topics in self._rows.items():
            times, data = topics.get(topic, ((), ()))
            step = -(-len(times) // most) or 1
            last = len(times) - 1
            chosen = sorted({*range(0, len(times), step), *((last,) if times else ())})
            found[robot] = series.rows(((times[index], self._decoded(data[index])) for index in chosen), fields)
        return {robot: rows for robot, rows in found.items() if rows}

    def check_charts(self, charts: Sequence[str]) -> None:
        """Raise `LocalError` where a chart, TOPIC:FIELD or TOPIC:FIELD.FIELD, would have no number."""
        for chart in charts:
            topic, _, field = chart.partition(":")
            if not self.series(topic, [tuple(field.split("."))]):
                there = ", ".join(sorted({topic for topics in self._rows.values() for topic in topics}))
                raise LocalError(
                    f"--chart {chart}: no robot has such a number; expected TOPIC:FIELD, e.g. "
                    f"app/consensus/state:state.value, and the topics are {there}"
                )

    def marks(self) -> list[tuple[float, str, str]]:
        """Return time, level and text of events in the whole run, for a strip of its time. Of too many, return the
        worst."""
        worst = sorted(self._events, key=lambda event: (LEVELS.index(event.level), event.t))[:MAX_MARKS]
        return sorted((event.t, event.level, f"{event.robot} {event.text}") for event in worst)

    def places(self, t: float) -> dict[str, tuple[float, float]]:
        """Return the robots' places at an instant, m."""
        found = {}
        for robot in self._rows:
            here = list(track(self._newest(robot, pose_topic(self._rows[robot]), t), -math.inf))
            if here:
                found[robot] = here[0]
        return found

    def parameters(self) -> dict[str, object]:
        """Return the parameters of the apps of the first robot that tells them, by `APP NAME`, as they were at the
        end."""
        for topics in self._rows.values():
            found: dict[str, object] = {}
            for topic, (_, data) in topics.items():
                told = dig(self._message(data[-1]), ("parameters",)) if topic.endswith("/parameters") else None
                if isinstance(told, dict):
                    app = topic.split("/")[1]
                    found |= {f"{app} {name}": dig(each, ("value",)) for name, each in told.items()}
            if found:
                return found
        return {}

    def _trail(self, robot: str, t: float) -> Iterator[tuple[float, float]]:
        return track(self._between(robot, pose_topic(self._rows[robot]), t - TRAIL_S, t), t - TRAIL_S)

    def _newest(self, robot: str, topic: str, t: float) -> Iterator[tuple[float, object]]:
        times, data = self._rows[robot].get(topic, ([], []))
        if index := bisect_right(times, t):
            yield times[index - 1], self._decoded(data[index - 1])

    def _between(self, robot: str, topic: str, since: float, t: float) -> Iterator[tuple[float, object]]:
        times, data = self._rows.get(robot, {}).get(topic, ([], []))
        for index in range(bisect_right(times, since), bisect_right(times, t)):
            yield times[index], self._decoded(data[index])

    def _message(self, data: bytes) -> object:
        """Return a message as a page gets it."""
        return json_value(self._decoded(data))

    def _decoded(self, data: bytes) -> object:
        """Return a message for those who look for numbers in it, in a third of the time."""
        try:
            return json_text.decode_lists(data)
        except (ValueError, RecursionError) as error:
            raise RecordingError(f"{self.path}: a message is not JSON: {error}") from None
