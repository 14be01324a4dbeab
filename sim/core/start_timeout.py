"""The time that a starting swarm may take."""

START_LIMIT_S = 60.0
"""Seconds in which nothing more becomes ready, after which a swarm that has not done its first iteration is given
up. A busy machine may take longer for the whole start; as long as more and more is ready, that is no fault of the
swarm."""


class StartTimeout:
    """Watches how much of a swarm is ready."""

    def __init__(self, now: float) -> None:
        self._most, self._since = 0, now

    def lost(self, ready: int, now: float) -> bool:
        """Take how many things are ready now; return whether the most so far is as old as `START_LIMIT_S`."""
        if ready > self._most:
            self._most, self._since = ready, now
        return now - self._since > START_LIMIT_S
