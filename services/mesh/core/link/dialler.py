"""Who dials whom, and when to try again."""

from collections.abc import Callable

from swarm.config.types import RobotConfig

FIRST_DELAY = 0.2
"""s until the second attempt."""

LONGEST_DELAY = 5.0
"""s between attempts at most: a robot that returns is met again within this time, and there is no last
attempt."""

JITTER = 0.5
"""Each delay is spread by this fraction up and down, so that robots that lost each other together do not
retry together."""

GOOD_AFTER = 1.0
"""s that a link must have been up for the back-off to start from the beginning again. Without it two
processes of one name, which replace each other's connection, would do so several times a second."""


def dials(me: RobotConfig, peer: RobotConfig) -> bool:
    """Whether `me` dials `peer`: the lower Bluetooth address does, or the lower name where one has none.

    With both ends dialling, Bluetooth pages collide: both fail after 5 s (measured, docs/frames.md).
    """
    if me.bluetooth is not None and peer.bluetooth is not None:
        return _address(me.bluetooth) < _address(peer.bluetooth)
    return me.name < peer.name


def can_link(a: RobotConfig, b: RobotConfig) -> bool:
    """Whether there can be a link between two robots: the one that is dialled has an address."""
    return has_address(b if dials(a, b) else a)


def has_address(robot: RobotConfig) -> bool:
    """Whether a robot can be called at all."""
    return robot.link is not None or robot.bluetooth is not None


def _address(text: str) -> bytes:
    return bytes.fromhex(text.replace(":", ""))


class Dialler:
    """When one neighbour is to be dialled. At most one attempt runs at a time; the first is due at once."""

    def __init__(self, random: Callable[[], float]) -> None:
        """`random` gives uniform numbers from 0 up to 1."""
        self._random = random
        self._failures = 0
        self._next: float | None = 0.0
        self._up_since: float | None = None

    def next_deadline(self) -> float | None:
        """When to dial; None while an attempt or a connection lasts."""
        return self._next

    def take(self, now: float) -> bool:
        """Whether to dial now; if so, the attempt has begun."""
        if self._next is None or now < self._next:
            return False
        self._next = None
        return True

    def up(self, now: float) -> None:
        """The attempt led to a link."""
        self._up_since = now
        self._next = None

    def ended(self, now: float) -> None:
        """The attempt failed or its link is down: plan the next one."""
        if self._up_since is not None and now - self._up_since >= GOOD_AFTER:
            self._failures = 0
        self._up_since = None
        delay = min(LONGEST_DELAY, FIRST_DELAY * 2.0 ** min(self._failures, 16))
        self._failures += 1
        self._next = now + delay * (1.0 - JITTER + 2.0 * JITTER * self._random())
