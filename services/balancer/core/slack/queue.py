"""The order of slack tasks: by importance, until one has waited for longer than its patience."""

import math
from collections.abc import Iterable
from dataclasses import dataclass

from services.balancer.core.slack.transfers import SlackTask

STARVED_S = 2.0
"""Seconds without a transfer, although one is wanted, after which the bus has no time for the task."""


@dataclass(eq=False)
class QueuedTask:
    """A slack task and how long it has waited."""

    name: str
    """The name in `balancer/state`."""
    task: SlackTask
    patience: float
    """Seconds without a transfer after which it goes before more important tasks."""
    since: float | None = None
    """The time at which it began to wait, or was served last while it still wants more; None where it wants nothing."""

    starved_at: float = -math.inf
    """The time at which it was last found that there is no time for it."""

    def wants(self, now: float) -> None:
        """Note that the task wants a transfer at `now`, s."""
        if self.since is None or now < self.since:
            self.since = now

    def served(self, now: float) -> None:
        """Note that the task had a transfer at `now`, s."""
        self.since = now

    def idle(self) -> None:
        """Note that the task has nothing to do."""
        self.since = None

    def waited(self, now: float) -> float:
        """Return how long the task has waited, s."""
        return 0.0 if self.since is None else now - self.since

    def urgency(self, now: float) -> float:
        """Return how many times its patience the task has waited; 0 up to once."""
        share = self.waited(now) / self.patience
        return share if share > 1.0 else 0.0


def by_urgency(tasks: Iterable[QueuedTask], now: float) -> list[QueuedTask]:
    """Return the task first that has lost its patience by the most; the others stay in their order."""
    return sorted(tasks, key=lambda each: -each.urgency(now))
