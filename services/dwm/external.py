"""Poses or ranges that another process on the robot's bus measures, in place of a DWM1001: `[dwm] source = "bus:KEY"`.

A motion capture system, a camera above the robots or a file may be that process (docs/how-to/tools/motion-capture.md).
"""

import queue

from services.dwm.core.module.tlv import AnchorRange, Location, Position
from services.dwm.localizer import Localizer
from swarm import clock
from swarm.errors import PayloadError
from swarm.messages import ExternalReport, Pose
from swarm.messages.codec import decode
from swarm.messages.keys import key
from swarm.process.runtime import refuse
from swarm.process.service import Service

SILENT_S = 2.0
"""Seconds without a report after which the service says that it lacks them."""
MAX_AGE_S = 10.0
"""A report that claims to be older is refused."""
_POLL = 0.25
"""Seconds between looks at whether to stop: a signal does not wake a queue."""
_MAX_WAITING = 100
_NO_FIX = Position(0.0, 0.0, 0.0, 0)


def serve(service: Service, source: str) -> None:
    """Publish what is reported on the key `source` until the service is to stop."""
    arrived: queue.Queue[ExternalReport] = queue.Queue(_MAX_WAITING)

    def take(name: str, payload: bytes) -> None:
        try:
            arrived.put_nowait(checked(decode(ExternalReport, payload, name)))
        except (PayloadError, queue.Full) as error:
            refuse(service, f"{name}: {error}")

    service.bus.subscribe(source, take)
    localizer = Localizer(service, clock.now(), external=True)
    service.ready()
    service.degraded(f"nothing is reported on {source} yet")
    heard: float | None = None
    sequence = 0
    while not service.stopping.is_set():
        service.watchdog()
        try:
            report = arrived.get(timeout=_POLL)
        except queue.Empty:
            if heard is not None and clock.now() > heard + SILENT_S:
                service.degraded(f"nothing is reported on {source} any more")
            continue
        heard = clock.now()
        service.ready()
        if report.x is None:
            localizer.report(location_of(report), heard - report.age)
        else:
            sequence += 1
            service.bus.publish(key(service.robot, "dwm", "pose"), pose_of(report, heard, sequence))


def checked(report: ExternalReport) -> ExternalReport:
    """Return the report, if it says where the robot is or how far anchors are, and when; raises `PayloadError`."""
    if (report.x is None) != (report.y is None) or (report.x is None) == (not report.ranges):
        raise PayloadError("expected either x and y, or ranges")
    if not 0.0 <= report.age <= MAX_AGE_S:
        raise PayloadError(f"age: expected 0 to {MAX_AGE_S:g} s, got {report.age:g}")
    if any(not 0.0 < distance < 1000.0 for distance in report.ranges.values()):
        raise PayloadError("ranges: expected distances above 0 and below 1000 m")
    return report


def location_of(report: ExternalReport) -> Location:
    """Return the report's ranges as a module would answer them."""
    ranges = (AnchorRange(anchor, distance, 100, _NO_FIX) for anchor, distance in report.ranges.items())
    return Location(_NO_FIX, tuple(ranges))


def pose_of(report: ExternalReport, now: float, sequence: int) -> Pose:
    """Return the report's place as the robot's pose."""
    assert report.x is not None and report.y is not None  # noqa: PT018 - `checked` has seen to it
    return Pose(
        now - report.age,
        sequence,
        report.x,
        report.y,
        report.heading,
        100,
        "external",
        deviation_x=report.deviation,
        deviation_y=report.deviation,
        correlation=None if report.deviation is None else 0.0,
    )
