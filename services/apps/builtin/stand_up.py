"""Robots stand up one after the other, like dominoes that get up (thesis 4.2.1). docs/reference/apps/stand_up.md."""

from collections.abc import Mapping, Sequence
from typing import Any

from swarm import PeriodicApp
from swarm.messages.codec import Value

LOOK_S = 0.1
"""Seconds between two looks at the own posture."""
LYING = ("front", "back", "upright")
"""Postures to stand up from; upright is held by a hand."""


class StandUp(PeriodicApp):
    """A robot stands up when a neighbour stands: within a period of it, since standing up itself takes less than 2 s.

    Standing is balancing: neither a robot on its back nor one that is still getting up counts. One in a fault (it fell,
    somebody stopped it) stays where it is until somebody has seen to it.
    """

    period = 6.0
    standing: bool = False

    def start(self) -> None:
        """Look at oneself from now on."""
        self.robot.after(0.0, "look")

    def on_timer(self, name: str) -> None:
        """The neighbours hear at once when this robot stands, or does not any more."""
        standing = self.robot.posture == "standing"
        if standing != self.standing:
            self.standing = standing
            self.robot.record("standing", standing)
        self.robot.after(LOOK_S, name)

    def on_button(self, button: str) -> None:
        """Be the first one."""
        if button == "a":
            self._rise("button")

    def on_neighbour(self, neighbour: Any) -> None:
        """Stand up where the neighbour stands."""
        if neighbour.standing:
            self._rise(neighbour.name)

    def step(self, neighbours: Sequence[Any]) -> None:
        """Once a period whatever was missed: a neighbour that stands while this robot does not."""
        for neighbour in neighbours:
            if neighbour.standing:
                self._rise(neighbour.name)
                return

    def _rise(self, why: str) -> None:
        if self.robot.posture in LYING and not self.robot.fault:
            self.robot.log.info("stands up after %s", why)
            self.robot.record("rises_after", why)
            self.robot.stand_up()

    def result(self) -> Mapping[str, Value]:
        """Return whether it stands, and how it lies or stands."""
        return {"standing": self.standing, "posture": self.robot.posture}
