"""Buttons: presses counted, so that who misses a message sees in the next one that there was a press."""

from swarm.messages import Buttons

REPEAT_S = 1.0
"""Seconds after which the state is published again, for subscribers that come late."""


class ButtonCounter:
    """Fed with the buttons of each tick (the ATmega debounces them over 10 ms, so no press is shorter than a tick)."""

    def __init__(self) -> None:
        self._down = 0
        self._presses = [0, 0, 0]
        self._tell_at = 0.0

    def update(self, down: int, now: float) -> Buttons | None:
        """`down`: bit 0 A, 1 B, 2 C. What is to be told, if anything."""
        if down == self._down and now < self._tell_at:
            return None
        for n in range(3):
            self._presses[n] += (down & ~self._down) >> n & 1
        self._down, self._tell_at = down, now + REPEAT_S
        return Buttons(now, bool(down & 1), bool(down & 2), bool(down & 4), *self._presses)
