"""Velocities from keys, with a dead-man's key: a robot moves only while keys come; no IO.

A terminal tells of presses and repeats, never of a release. So a velocity holds for a short time after each key: after
the first one as long as keyboards take until they repeat, then for a few repeats.
"""

from swarm.frozen import frozen

FIRST_S = 0.7
"""Seconds that the first press holds: keyboards repeat after 0.25 to 0.66 s (Linux' console, X11)."""
REPEAT_S = 0.2
"""Seconds that each repeat holds: keyboards repeat each 0.03 to 0.1 s. So long a robot drives on after a release."""

SPEED = 0.2
"""Speed at the gear with which a drive begins, m/s."""
TURN_RATE = 1.5
"""Turn rate while a key is held, rad/s."""
GEARS = (0.25, 0.5, 1.0, 1.5, 2.0)
"""Factors of speed and turn rate, for the keys - and +."""
FIRST_GEAR = 2

DIRECTIONS = {
    "up": (1, 0), "w": (1, 0),
    "down": (-1, 0), "s": (-1, 0),
    "left": (0, 1), "a": (0, 1),
    "right": (0, -1), "d": (0, -1),
    "q": (1, 1),
    "e": (1, -1),
}  # fmt: skip
"""Forward and to the left by key; q and e drive curves, since a terminal repeats one key at a time."""


@frozen
class Velocity:
    """The velocity to command: m/s, rad/s to the left, and for how many seconds it holds."""

    speed: float
    turn_rate: float
    seconds: float


STANDSTILL = Velocity(0.0, 0.0, REPEAT_S)


class KeyVelocity:
    """Turns keys into velocities."""

    def __init__(self) -> None:
        self._key = ""
        self._until = float("-inf")
        self._gear = FIRST_GEAR

    @property
    def deadline(self) -> float | None:
        """Return the time at which `handle_timer` is due; None while nothing is commanded."""
        return self._until if self._key else None

    @property
    def fastest(self) -> tuple[float, float]:
        """Return speed and turn rate of the gear in use, m/s and rad/s."""
        return SPEED * GEARS[self._gear], TURN_RATE * GEARS[self._gear]

    def press(self, key: str, now: float) -> Velocity | None:
        """Take a key; returns what is to be commanded now, None where nothing changes.

        Every key that is no direction ends the motion: whoever presses something else has let go.
        """
        if key in ("+", "-"):
            step = 1 if key == "+" else -1
            self._gear = min(len(GEARS) - 1, max(0, self._gear + step))
        if key not in DIRECTIONS:
            return self.release()
        repeats = key == self._key and now < self._until
        hold = REPEAT_S if repeats else FIRST_S
        # A repeat may come sooner than the first press runs out; another key before it holds on as a first one.
        self._key, self._until = key, now + hold
        forward, left = DIRECTIONS[key]
        speed, turn_rate = self.fastest
        return Velocity(forward * speed, left * turn_rate, hold)

    def handle_timer(self, now: float) -> Velocity | None:
        """Return the standstill where no key has come in time, else None."""
        return self.release() if self._key and now >= self._until else None

    def release(self) -> Velocity | None:
        """Return the standstill where something moves, else None."""
        if not self._key:
            return None
        self._key = ""
        return STANDSTILL
