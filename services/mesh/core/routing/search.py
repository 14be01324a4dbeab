"""Looking for robots by calling them: which one to call next, and when.

The targets are robots that we would dial and have no link with. Those out of the swarm's reach (`far`) are called again
and again, with a growing pause; those in the swarm whom we have not reached ourselves (`near`) to learn whether we hear
each other, which the automatic topology wants to know. One call at a time: a page of an absent robot takes a Bluetooth
adapter 5 s. (An inquiry takes it 10 s, finds also what is not ours, and needs PyBluez: that is `swarm discover`.)
"""

from collections.abc import Callable, Collection

FIRST_PAUSE = 0.5
"""s within which a new target is called for the first time."""

PAUSE = 1.0
"""s after the first call that failed; doubles with each further one."""

LONGEST_FAR, LONGEST_NEAR = 30.0, 300.0
"""s between two calls at most. Who is in the swarm lacks nothing if we do not hear it."""

JITTER = 0.5
"""Pauses are spread by this fraction up and down."""

_NEVER = float("inf")


class _Target:
    __slots__ = ("failures", "far", "next_at")

    def __init__(self, far: bool, next_at: float) -> None:
        self.far = far
        self.failures = 0
        self.next_at = next_at


class Search:
    """The calls of one robot."""

    def __init__(self, random: Callable[[], float]) -> None:
        """`random` gives numbers from 0 up to 1."""
        self._random = random
        self._targets: dict[str, _Target] = {}
        self.calling: str | None = None
        """Whom we are calling."""

    def aim(self, far: Collection[str], near: Collection[str], now: float) -> None:
        """These are the targets now. One that is new, or went from near to far, is called soon."""
        for name in self._targets.keys() - set(far) - set(near):
            del self._targets[name]
        for names, is_far in ((far, True), (near, False)):
            for name in names:
                target = self._targets.get(name)
                if target is None or target.far != is_far:
                    self._targets[name] = _Target(is_far, now + FIRST_PAUSE * self._random())

    def take(self, now: float) -> str | None:
        """Whom to call now; the far ones first. To be followed by `ended`."""
        if self.calling is None:
            due = [(not target.far, target.next_at, name) for name, target in self._targets.items()
                   if now >= target.next_at]  # fmt: skip
            if due:
                self.calling = min(due)[2]
                return self.calling
        return None

    def ended(self, name: str, now: float) -> None:
        """A call is over. If it was of use the robot is no target any more; if not, it is called again later."""
        if name == self.calling:
            self.calling = None
        target = self._targets.get(name)
        if target is not None:
            longest = LONGEST_FAR if target.far else LONGEST_NEAR
            pause = min(longest, PAUSE * 2.0 ** min(target.failures, 16))
            target.failures += 1
            target.next_at = now + pause * (1.0 - JITTER + 2.0 * JITTER * self._random())

    def next_deadline(self) -> float:
        """When `take` has somebody."""
        if self.calling is not None:
            return _NEVER
        return min((target.next_at for target in self._targets.values()), default=_NEVER)
