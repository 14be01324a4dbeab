"""Stop by rule: all robots of a lockstep stop at the same iteration, without a leader.

Each robot carries one number with its state. Up to a threshold it counts for how many rounds everybody near has been
content: c_i(k+1) = 1 + min over i and its neighbours of c(k), or 0 where robot i itself is not. So c_i = m says that
all robots at d hops were content until d rounds ago, for m - d rounds; with D at least the diameter and m = D + R,
everybody was for R rounds. Then the number turns into a wave: whoever has reached the threshold, or whose time is up,
counts on whatever happens, and takes over the highest number of a neighbour beyond it: c_i(k+1) = 1 + max. After D more
rounds the first wave is everywhere, with the same number on all robots: there they stop.
"""

import struct
from collections.abc import Iterable

from swarm.core.graph import Graph
from swarm.errors import LocalError
from swarm.frozen import frozen

_COUNT = struct.Struct("<H")
MOST = 0xFFFF
_UNMET = "not converged within"


@frozen
class Rule:
    """The rule of an app for when its run stops."""

    rounds: int | None = None
    """Rounds for which all robots must have been content; None: that is no reason to stop."""
    seconds: float | None = None
    """Time from a robot's first state to when it wants to stop; the first robot's counts."""


def is_unmet(reason: str) -> bool:
    """Return whether this is why a run ended that was to converge and has not. The run itself is whole."""
    return reason.startswith(_UNMET)


class Stopping:
    """The count of one robot in one epoch."""

    size = _COUNT.size
    """Bytes that travel with each state."""

    def __init__(self, rule: Rule, graph: Graph) -> None:
        """Raises `LocalError` where the count would not fit."""
        self.rule = rule
        self._reach = graph.span
        self._threshold = self._reach + (1 if rule.rounds is None else rule.rounds)
        if self._threshold + self._reach > MOST:
            raise LocalError(f"stop after {rule.rounds} rounds: at most {MOST - 2 * self._reach} are possible")

    def next(self, own: bytes, neighbours: Iterable[bytes], *, content: bool, seconds: float) -> bytes:
        """Return the count that goes with x(k+1), from those that came with x(k)."""
        counts = [_COUNT.unpack(own)[0], *(_COUNT.unpack(count)[0] for count in neighbours)]
        if (highest := max(counts)) >= self._threshold:
            count = min(highest + 1, MOST)
        elif self.rule.seconds is not None and seconds >= self.rule.seconds:
            count = self._threshold
        elif self.rule.rounds is not None and content:
            count = 1 + min(counts)
        else:
            count = 0
        return _COUNT.pack(count)

    def over(self, count: bytes) -> bool:
        """Return whether the iteration with this count is the last one."""
        number: int = _COUNT.unpack(count)[0]
        return number >= self._threshold + self._reach

    def unmet(self, k: int, count: bytes) -> str:
        """Return what is amiss with a run whose last iteration k has this count: it was to converge, and has not."""
        return "" if self.rule.rounds is None or self.over(count) else f"{_UNMET} {k} iterations"

    @staticmethod
    def first() -> bytes:
        """Return the count that goes with the first state."""
        return _COUNT.pack(0)
