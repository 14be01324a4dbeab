"""Messages of the hosts of apps."""

from dataclasses import dataclass

from swarm.codec import Value
from swarm.messages.service import Status


@dataclass(frozen=True, slots=True)
class AppState:
    """An app's shared state by name, on `swarm/<robot>/app/<app>/state`, at most 10 Hz and at the end. A channel of an
    app has its name behind the app's: `.../app/<app>/<channel>/state`."""

    t: float
    k: int
    """Iteration."""
    state: dict[str, Value]
    result: dict[str, Value]
    """What the app reports as its result so far (units in docs of the app)."""


@dataclass(frozen=True, slots=True)
class AppProgress:
    """What an app is doing, on `swarm/<robot>/app/<app>/progress`: on change and once a second."""

    t: float
    phase: str
    """starting, waiting, running, done or fault."""
    k: int
    waiting_for: tuple[str, ...]
    """Neighbours whose value is missing (named within 3 s)."""
    reason: str
    """Why it is in fault or waits; empty otherwise."""


TOPICS: dict[tuple[str, str], type] = {
    ("app", "*/status"): Status,
    ("app", "*/state"): AppState,
    ("app", "*/progress"): AppProgress,
    ("app", "*/*/state"): AppState,
    ("app", "*/*/progress"): AppProgress,
}
"""Message type of each key, by (service, topic); `*` is any one chunk."""
