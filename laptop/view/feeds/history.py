"""The samples of one robot's keys in the last two minutes, as they came, for a chart that is opened late.

The bytes are bounded, by key and in all: a robot may say as much as it can, and what is kept of it is decoded at once
when a page asks for a key.
"""

from collections import deque
from collections.abc import Iterator

HISTORY_S = 120.0
"""Length of the history, s."""

HISTORY_STEP_S = 0.2
"""Least time between two entries of a key, s."""

MAX_KEY = 1 << 20
"""The most bytes of one key. A message of empty maps takes seventy times its size when it is decoded."""

MAX_ROBOT = 16 << 20
"""The most bytes of all keys of a robot. The newest sample of each key is kept in any case."""

_ENTRY = 128
"""Bytes that an entry takes beside its payload."""

_Rows = deque[tuple[float, bytes]]


class History:
    """The history of one robot. Times are the caller's clock, s."""

    def __init__(self) -> None:
        self._keys: dict[str, _Rows] = {}
        self._sizes: dict[str, int] = {}
        self._size = 0
        """Size of all keys, bytes."""

    def add(self, topic: str, payload: bytes, now: float) -> None:
        """Keep a sample where the newest one of its key is older than a step. Samples that are too old or too many are
        dropped."""
        rows = self._keys.setdefault(topic, deque())
        if rows and rows[-1][0] <= now < rows[-1][0] + HISTORY_STEP_S:
            return
        rows.append((now, payload))
        self._count(topic, _ENTRY + len(payload))
        while len(rows) > 1 and (
            rows[0][0] < now - HISTORY_S or self._sizes[topic] > MAX_KEY or self._size > MAX_ROBOT
        ):
            self._count(topic, -_ENTRY - len(rows.popleft()[1]))

    def rows(self, topic: str) -> Iterator[tuple[float, bytes]]:
        """Return the values of a key, oldest first."""
        return iter(self._keys.get(topic, ()))

    def at(self, t: float) -> Iterator[tuple[str, bytes]]:
        """Yield the value of each key at an instant, except for keys that are younger, or whose past is not kept any
        more."""
        for topic, rows in self._keys.items():
            if (payload := next((each for at, each in reversed(rows) if at <= t), None)) is not None:
                yield topic, payload

    def _count(self, topic: str, size: int) -> None:
        self._sizes[topic] = self._sizes.get(topic, 0) + size
        self._size += size
