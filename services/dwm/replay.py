"""A recording in place of a module: row k is answered to whoever asks, and published when first asked for.

The app asks `dwm/measurement?sequence=k` for the row that takes it from iteration k to k+1. An answer depends
on the recording alone: the same however often and by whomever it is asked. Past the end there is none.
"""

import queue
from collections.abc import Callable

from swarm import clock
from swarm.frozen import frozen
from swarm.messages import Measurement, Pose, Range, Ranges
from swarm.messages.codec import encode
from swarm.messages.keys import key
from swarm.process.service import Service
from swarm.recording.thesis_ranges import ThesisRecording

NOBODY = "0000"
"""Address under which the target is published where the config names none."""


@frozen
class _Row:
    """Row `k` of a recording as messages."""

    recording: ThesisRecording
    k: int

    def measurement(self) -> Measurement:
        """Return the measurement that the app asks for. Its `t` is the recording's own time, so a row has one answer
        for ever."""
        distance, x, y = self.recording.rows[self.k]
        return Measurement(self.recording.times[self.k], self.k, distance, x, y)

    def published(self, target: str, now: float) -> tuple[Ranges, Pose]:
        """Return the messages in the form of live data. Recordings hold no quality factors: full quality is claimed."""
        distance, x, y = self.recording.rows[self.k]
        item = Range(target, distance, distance, 100, 0.0, self.k)
        return Ranges(now, self.k, (item,)), Pose(now, self.k, x, y, None, 100, "recording")


def serve(service: Service, recording: ThesisRecording) -> None:
    """Answer and publish rows until the service is to stop."""
    first_asked: queue.SimpleQueue[int] = queue.SimpleQueue()
    newest = -1

    def answer(_: str, parameters: dict[str, str]) -> bytes | None:
        nonlocal newest
        k = _asked(parameters)
        if k is None:
            service.counters["wrong_queries"] += 1
            return None
        if k >= recording.steps:
            service.counters["past_end"] += 1
            service.log.warning("row %d was asked for, the recording ends at row %d", k, recording.steps - 1)
            return None
        if k > newest:  # the bus calls us on one thread
            newest = k
            first_asked.put(k)
        return encode(_Row(recording, k).measurement())

    robot, target = service.robot, service.config.dwm.target or NOBODY
    service.bus.serve(key(robot, "dwm", "measurement"), answer)
    service.log.info("replays %s rows=%d", recording.path, recording.steps)
    service.ready()
    while not service.stopping.is_set():
        service.watchdog()
        try:
            k = first_asked.get(timeout=0.25)  # a signal does not wake a queue: this bounds the time to stop
        except queue.Empty:
            continue
        ranges, pose = _Row(recording, k).published(target, clock.now())
        service.bus.publish(key(robot, "dwm", "ranges"), ranges)
        service.bus.publish(key(robot, "dwm", "pose"), pose)


def measured(recording: ThesisRecording, k: int) -> Measurement | None:
    """Return the measurement of a row; None behind the last one."""
    return None if k >= recording.steps else _Row(recording, k).measurement()


def answer_row(rows: Callable[[int], Measurement | None], key: str, parameters: dict[str, str]) -> bytes | None:
    """Answer the query for a row by `rows(k)`; None where there is none."""
    k = _asked(parameters)
    row = None if k is None else rows(k)
    return None if row is None else encode(row)


def _asked(parameters: dict[str, str]) -> int | None:
    """Return the row that a query asks for; None where it names none."""
    text = parameters.get("sequence", "")
    return int(text) if text.isascii() and text.isdigit() and len(text) < 10 else None
