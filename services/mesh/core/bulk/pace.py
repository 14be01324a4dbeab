"""How many pieces to ask one robot for at a time: enough to keep the way busy, too few to fill its queues.

Each piece comes one round trip after it was asked for, and longer where it waited behind others. From the shortest
round trip and the mean of the last ones follows how many of the bytes asked for stand in some queue on the way (TCP
Vegas, Brakmo and Peterson 1995): fewer than `QUEUED_LEAST` and the window grows, more than `QUEUED_MOST` and it
shrinks. Who shares a way thus gets a share, and whatever else uses it waits for some `QUEUED_MOST` of each at most.
"""

from services.mesh.core.bulk.pieces import SIZE

FIRST = 12 * SIZE
"""Bytes asked for at first; three of the thesis' links hold 14 kB, 78 kB/s x 180 ms."""

LEAST = 2 * SIZE
MOST = 128 * 1024

QUEUED_LEAST = 8 * SIZE
QUEUED_MOST = 14 * SIZE

LOST = 0.7
"""Factor of the window after pieces were lost, once a round trip."""

BASE_WINDOW = 15.0
"""s; the shortest round trip is taken over one to two of these, since ways change."""

FIRST_PATIENCE = 1.0
"""s until pieces are asked for again, before a round trip was measured;"""

LEAST_PATIENCE = 0.3
MOST_PATIENCE = 4.0
"""and the bounds once one was; it doubles each time."""


class Pace:
    """The window towards one robot."""

    def __init__(self) -> None:
        self.window = float(FIRST)
        self._base = [float("inf"), float("inf")]
        self._base_until = 0.0
        self._rtt = 0.0
        self._deviation = 0.0
        self._timeouts = 0
        self._began = 0.0
        """When the present round began: it ends with the first piece that was asked for later."""
        self._sum = 0.0
        self._count = 0
        self._full = False
        self._starting = True

    @property
    def patience(self) -> float:
        """s after which a piece that was asked for is taken for lost (RFC 6298, section 2)."""
        if not self._rtt:
            first = FIRST_PATIENCE
        else:
            first = max(LEAST_PATIENCE, self._rtt + 4 * self._deviation + LEAST_PATIENCE / 2)
        return min(MOST_PATIENCE, first * 2.0 ** min(self._timeouts, 8))

    def full(self) -> None:
        """The window kept a piece from being asked for."""
        self._full = True

    def arrived(self, rtt: float, now: float) -> None:
        """A piece came, so long after it was asked for."""
        self._timeouts = 0
        if self._rtt:
            self._deviation += 0.25 * (abs(rtt - self._rtt) - self._deviation)
            self._rtt += 0.125 * (rtt - self._rtt)
        else:
            self._rtt, self._deviation = rtt, rtt / 2
        if now >= self._base_until:
            self._base_until = now + BASE_WINDOW
            self._base = [self._base[1], rtt]
        self._base[1] = min(self._base[1], rtt)
        self._sum += rtt
        self._count += 1
        if now - rtt >= self._began:
            self._judge()
            self._begin(now)

    def lost(self, now: float) -> None:
        """Pieces behind one that came are missing."""
        if now >= self._began + self._rtt / 2:
            self._starting = False
            self.window = max(float(LEAST), self.window * LOST)
            self._begin(now)

    def silent(self, now: float) -> None:
        """Nothing came for `patience`."""
        self._timeouts += 1
        self._starting = False
        self.window = max(float(LEAST), self.window / 2)
        self._begin(now)

    def _begin(self, now: float) -> None:
        self._began, self._sum, self._count, self._full = now, 0.0, 0, False

    def _judge(self) -> None:
        mean = self._sum / self._count
        queued = self.window * (1.0 - min(self._base) / mean) if mean else 0.0
        if queued > QUEUED_MOST:
            self._starting = False
            self.window = max(float(LEAST), self.window - (queued - QUEUED_MOST) / 2)
        elif queued < QUEUED_LEAST and self._full:
            self.window = min(float(MOST), self.window * 1.5 if self._starting else self.window + 2 * SIZE)
        elif queued >= QUEUED_LEAST:
            self._starting = False
