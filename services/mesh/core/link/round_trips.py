"""Round trips: those that heartbeats measure on a connection, and what a window learns from the bytes it lets through.

`Pulse` has what the heartbeats of one connection tell: round trips, the other clock, bytes per second. `RoundTrips`
smooths round trips, for `Pulse` and for the window of a link (`link.flow`).
"""

from collections import deque

from services.mesh.core.link.calls import Local
from services.mesh.core.wire.frames import Heartbeat

RTT_SAMPLES = 120
"""Round-trip times kept, a minute of heartbeats."""

_RTT_GAIN, _DEVIATION_GAIN = 0.125, 0.25
"""Weights of a new round-trip sample (Jacobson 1988, RFC 6298 section 2)."""

LEAST_OVER = 15.0
"""s; the shortest round trip is taken over one to two of these: ways change, a link may get slower for good."""

_MAX_RTT = 60.0
"""s; a longer sample comes from wrong stamps."""

MAX_APART = 1e10
"""Seconds by which two monotonic clocks may differ; a larger difference comes from wrong stamps."""

DEVIATIONS = 4.0
"""Deviations above the smoothed round trip within which an answer is expected (RFC 6298 section 2: RTO)."""

KNOWN = 8
"""Round trips after which a connection's are known."""

TAIL = 0.95
"""Share of the last minute's round trips that are expected, too: where robots share their time among piconets the
deviation forgets within seconds that a link has been slow."""


class RoundTrips:
    """Smoothed round-trip time, how far samples are from it, and the shortest one of late, all in s."""

    def __init__(self) -> None:
        self.smoothed = 0.0
        """0 while none was measured."""
        self.deviation = 0.0
        self._least = [float("inf"), float("inf")]
        self._least_until = 0.0

    @property
    def least(self) -> float:
        """The shortest one of late; infinite while none was measured."""
        return min(self._least)

    def add(self, rtt: float, now: float, *, usual: bool = True) -> None:
        """Note a round trip. It is smoothed if it is `usual`, or if it is the first one."""
        if self.smoothed and usual:
            self.deviation += _DEVIATION_GAIN * (abs(rtt - self.smoothed) - self.deviation)
            self.smoothed += _RTT_GAIN * (rtt - self.smoothed)
        elif not self.smoothed:
            self.smoothed, self.deviation = rtt, rtt / 2
        if now >= self._least_until:
            self._least_until = now + LEAST_OVER
            self._least = [self._least[1], rtt]
        self._least[1] = min(self._least[1], rtt)


SUSPECT_AFTER, DEAD_AFTER = 1.0, 3.0
"""Times that an answer is expected in, besides a heartbeat's period, after which silence is suspicious, and the end."""

UNKNOWN_AFTER = 2.0
"""Times as long as a handshake may take after which such a link ends whose round trips are not known yet: its own
handshake may have been a quick one."""

BRIDGED_AFTER = 5.0
"""Times as long as the longest round trip of late after which a link whose ends may be in several piconets ends: two
ends can miss one another for longer than a few dozens of heartbeats have shown."""


class Pulse:
    """One end of a connection, from heartbeat to heartbeat."""

    def __init__(self, now: float) -> None:
        self.rtt: float | None = None
        """Smoothed round-trip time, s."""
        self.rtts: deque[float] = deque(maxlen=RTT_SAMPLES)
        """Round-trip times of the last heartbeats, s."""
        self.expected = 0.0
        """Seconds within which an answer is expected."""
        self._round_trips = RoundTrips()
        self.longest = 0.0
        """The longest of `rtts`, s."""
        self._usual = 0.0
        """Median of `rtts`, s."""
        self.sent_rate = 0.0
        """bytes/s over the last heartbeats."""
        self.received_rate = 0.0
        self._rated = (now, 0, 0)
        self._peer_stamp = 0
        self._peer_stamp_at = 0

    def begin(self, rtt: float, now: float) -> None:
        """The handshake took so long; nothing else is known yet. It is no round trip for others: both ends may have
        waited in it."""
        self._round_trips.add(rtt, now)
        self.expected = rtt + DEVIATIONS * self._round_trips.deviation

    def period(self, least: float) -> float:
        """Return the time between two heartbeats, s: `least`, or twice that where half of it is shorter than the usual
        round trip. More heartbeats would tell little, and each frame takes time of a slow radio."""
        return 2.0 * least if self._usual > least / 2.0 else least

    def is_steady(self, least: float) -> bool:
        """Return whether round trips are known, and half of them are shorter than a quarter of `least`, as in `period`:
        not nearly all, since those of a hub are long while it still calls others."""
        return len(self.rtts) >= KNOWN and self._usual <= least / 4.0

    def silence(self, least: float, answers: float) -> float:
        """Return the seconds in which a heartbeat and so many answers are expected; `least` as in `period`."""
        return self.period(least) + answers * self.expected

    def suspect_after(self, local: Local) -> float:
        """Return the seconds of silence after which the link is suspect: as configured, or more where its round trips
        ask for it."""
        return min(max(local.times.suspect, self.silence(local.times.heartbeat, SUSPECT_AFTER)), local.times.patience)

    def dead_after(self, local: Local) -> float:
        """Return the seconds of silence after which the link ends. They are more where robots share their radio's time
        among piconets, until round trips show that these two hardly do."""
        least = max(local.times.dead, self.silence(local.times.heartbeat, DEAD_AFTER))
        if local.pages and not self.is_steady(local.times.heartbeat):
            young = UNKNOWN_AFTER if len(self.rtts) < KNOWN else 1.0
            least = max(least, young * local.times.handshake, BRIDGED_AFTER * self.longest)
        return min(least, local.times.patience)

    def next_beat(self, now: float, least: float, incarnation: int) -> float:
        """Return when the next heartbeat is due. Those of all links of a robot leave together: each time it wakes
        costs. Robots have moments of their own, by their incarnation."""
        wait = least - (now - incarnation % 1024 / 1024 * least) % least
        return now + (wait if wait > least / 4 else wait + least) + (self.period(least) - least)

    def beat(self, now: float, sent: int, received: int) -> Heartbeat:
        """Return the heartbeat to send after so many bytes each way."""
        since, sent_before, received_before = self._rated
        if now > since:
            self.sent_rate = (sent - sent_before) / (now - since)
            self.received_rate = (received - received_before) / (now - since)
            self._rated = (now, sent, received)
        return Heartbeat(self._peer_stamp, self._peer_stamp_at, _microseconds(now))

    def heard(self, stamps: Heartbeat, now: float) -> tuple[float, float] | None:
        """Return the round trip that a heartbeat of the other end closes and how far its clock is ahead of ours, both
        in s; None where it closes none."""
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
        self._round_trips.add(rtt, now)
        ordered = sorted(self.rtts)
        self._usual, self.longest = ordered[len(ordered) // 2], ordered[-1]
        tail = ordered[int(TAIL * len(ordered))]
        self.expected = max(self._round_trips.smoothed + DEVIATIONS * self._round_trips.deviation, tail)
        return rtt, apart


def _microseconds(now: float) -> int:
    return int(now * 1e6)
