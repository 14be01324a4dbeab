"""The times at which a robot in lockstep asks for missing values: not for values that are only late, and never
giving up."""

from collections.abc import Iterable

WANT_AFTER_RTTS = 3.0
"""A missing value is asked for after so many round-trip times without progress ..."""
WANT_AFTER = 0.2
"""... but not before this, in seconds: a loaded robot is late by a tenth of a second without any loss, and links lose
nothing without saying so (`Lockstep.nudge`)."""
WANT_AFTER_USUAL = 2.0
"""... nor before so many times what all but three of the last `RECENT` iterations took at most. Robots that share their
radio's time among piconets get some values ten times as late as most. An estimate from a window of the last arrivals,
as Chen, Toueg and Aguilera (2002) have it; one by deviations (RFC 6298) is misled for long by a single outage."""
LATE_RTTS = 10.0
"""... but after so many round-trip times in any case, or `WANT_AFTER_MOST`: a lost value that was asked for late makes
other robots' values late, and would make the next question later still."""
RECENT = 32
LEAST = 4
"""Iterations of which that is known; the first ones of a run wait for links."""
WANT_AFTER_MOST = 1.0
"""The interval between two questions doubles up to this, in seconds, and is kept for ever."""


class QuestionTimes:
    """The time of the next question. It learns how long iterations take."""

    def __init__(self) -> None:
        self.due = 0.0
        """The time of the next question."""
        self.interval = 0.0
        """Seconds from now, or from the last question, to the next one."""
        self._asked_at = float("-inf")
        self._unheard: set[str] | None = None
        """Robots asked in this iteration of which nothing shows that they are late; None before the first question."""
        self._recent: list[float] = []
        """Seconds that the last iterations took."""
        self._late_after = 0.0
        """Seconds after which one has taken too long; 0 while nothing is known."""

    def took(self, since: float, now: float, rtt: float) -> None:
        """Learn from an iteration that is over. What came a round trip after it was asked for may have been lost, and
        says nothing of how late values come (Karn 1987); what came sooner was only late, and so was the value of a
        robot that answered that it has none yet."""
        if self._unheard and self._asked_at <= now - rtt:
            return
        recent = self._recent
        recent.append(now - since)
        if len(recent) > RECENT:
            del recent[0]
        if len(recent) >= LEAST:
            usual = sorted(recent)[-3 - len(recent) // RECENT]
            self._late_after = min(WANT_AFTER_USUAL * usual, max(LATE_RTTS * rtt, WANT_AFTER_MOST))

    def progress(self, now: float, rtt: float) -> None:
        """Begin the times of a new iteration."""
        self.interval = max(WANT_AFTER_RTTS * rtt, WANT_AFTER, self._late_after)
        self.due = now + self.interval
        self._unheard = None

    def wait_for_start(self, now: float) -> None:
        """Wait longer in the first iteration, since neighbours are yet to start."""
        self.due = now + max(self.interval, WANT_AFTER_MOST)

    def asked(self, peers: Iterable[str], now: float, rtt: float) -> None:
        """Note that a question went out to robots; the interval to the next one doubles."""
        if self._unheard is None:
            self._unheard = set(peers)
        self._asked_at = now
        self.due = now + self.interval
        self.interval = max(min(2 * self.interval, WANT_AFTER_MOST), WANT_AFTER_RTTS * rtt, self._late_after)

    def is_late(self, peer: str) -> None:
        """Note that a robot has shown that it has not computed yet what is missing: it was not lost."""
        if self._unheard:
            self._unheard.discard(peer)

    def hurry(self, now: float, since: float, rtt: float) -> None:
        """Ask now, but not within a round trip of the last question or of `since`, when the iteration began: six links
        that come up together are one reason to ask, not six; and with a link that has been up all the time, of which
        only the host has just heard, everything is on its way."""
        self.due = min(self.due, max(now, self._asked_at + rtt, since + rtt))
