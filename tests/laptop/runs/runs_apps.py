"""Apps as a test's own file has them: classes, not files."""

from math import fsum
from typing import Annotated

from swarm import EventApp, PeriodicApp, SyncApp, Vector, channel, parameter


class Mean(SyncApp):
    """Every robot ends on the mean of the first values."""

    x: float
    gain: float = parameter(1.0)

    def step(self, neighbours):
        self.x += self.gain * fsum(w * (n.x - self.x) for w, n in self.weighted(neighbours))


class Place(SyncApp):
    """A vector, an integer, a truth value and a text beside the state."""

    q: Annotated[Vector, 2]
    count: int
    even: bool

    def step(self, neighbours):
        self.q = (self.q[0] + 1.0, self.q[1])
        self.count += 1
        self.even = self.count % 2 == 0

    def result(self):
        return {"far": sum(self.q), "word": "even" if self.even else "odd"}


class Raises(SyncApp):
    x: float

    def step(self, neighbours):
        self.x = 1.0 / (3 - self.k)


class NeverStarts(SyncApp):
    x: float

    def start(self):
        self.x = 1.0 / self.x

    def step(self, neighbours):
        self.x += 1.0


class Light(PeriodicApp):
    lit: bool
    period = 0.2

    def step(self, neighbours):
        self.lit = self.lit or any(n.lit for n in neighbours)

    def on_button(self, button):
        self.lit = True


class Beside(EventApp):
    mean = channel(Mean)

    def start(self):
        self.mean.x = float(self.robot.swarm.index(self.robot.name))
