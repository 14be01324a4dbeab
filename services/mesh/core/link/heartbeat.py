"""What the heartbeats of one connection tell: round trips, the other clock, bytes per second."""

from collections import deque

from services.mesh.core.wire.frames import Heartbeat

RTT_SAMPLES = 120
"""Round-trip times kept, a minute of heartbeats."""

_RTT_GAIN = 0.125
"""Weight of a new round-trip sample (Jacobson 1988, RFC 6298 section 2)."""

_MAX_RTT = 60.0
"""s; a longer sample comes from wrong stamps."""

MAX_APART = 1e10
"""Seconds by which two monotonic clocks may differ; a larger difference comes from wrong stamps."""


class Pulse:
    """One end of a connection, from heartbeat to heartbeat."""

    __slots__ = (
        "_peer_stamp",
        "_peer_stamp_at",
        "_rated",
        "received_rate",
        "rtt",
        "rtts",
        "sent_rate",
    )

    def __init__(self, now: float) -> None:
        self.rtt: float | None = None
        """Smoothed round-trip time, s."""
        self.rtts: deque[float] = deque(maxlen=RTT_SAMPLES)
        """Round-trip times of the last heartbeats, s."""
        self.sent_rate = 0.0
        """bytes/s over the last heartbeats."""
        self.received_rate = 0.0
        self._rated = (now, 0, 0)
        self._peer_stamp = 0
        self._peer_stamp_at = 0

    def beat(self, now: float, sent: int, received: int) -> Heartbeat:
        """The heartbeat to send after so many bytes each way."""
        since, sent_before, received_before = self._rated
        if now > since:
            self.sent_rate = (sent - sent_before) / (now - since)
            self.received_rate = (received - received_before) / (now - since)
            self._rated = (now, sent, received)
        return Heartbeat(self._peer_stamp, self._peer_stamp_at, _microseconds(now))

    def heard(self, stamps: Heartbeat, now: float) -> tuple[float, float] | None:
        """The round trip that a heartbeat of the other end closes and how far its clock is ahead of ours, both in s;
        None where it closes none."""
        arrival = _microseconds(now)
        self._peer_stamp, self._peer_stamp_at = stamps.sent, arrival
        if not stamps.echo:
            return None
        rtt = ((arrival - stamps.echo) - (stamps.sent - stamps.received)) * 1e-6
        if not 0.0 <= rtt <= _MAX_RTT:
            return None
        # Half of what the two directions' stamps differ (RFC 5905, section 8).
        apart = ((stamps.received - stamps.echo) + (stamps.sent - arrival)) * 0.5e-6
        if abs(apart) > MAX_APART:
            return None
        self.rtts.append(rtt)
        self.rtt = rtt if self.rtt is None else self.rtt + _RTT_GAIN * (rtt - self.rtt)
        return rtt, apart


def _microseconds(now: float) -> int:
    return int(now * 1e6)
