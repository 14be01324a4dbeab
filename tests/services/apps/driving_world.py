"""A small world of driven robots, for the control laws: unicycles with ramps, poses with errors, news that is late."""

import math
import random
from collections import deque
from collections.abc import Callable

from services.apps.core.unicycle import UnicyclePose

DT = 0.02
ACCELERATION, TURN_ACCELERATION = 0.5, 6.0


class Body:
    """A differential drive as the balancer has it (config [balancing]), seen through an EKF's errors."""

    def __init__(self, pose: UnicyclePose, generator: random.Random, sigma: float, delay: float) -> None:
        self.x, self.y, self.heading = pose
        self.speed = self.turn_rate = 0.0
        self.wanted = (0.0, 0.0)
        self._generator, self._sigma = generator, sigma
        self._error = [generator.gauss(0.0, sigma) for _ in range(2)]
        self._heading_error = generator.gauss(0.0, 0.05)
        self._told: deque[UnicyclePose] = deque(maxlen=max(1, round(delay / DT)))
        self._told.append(self.estimate)

    @property
    def place(self) -> tuple[float, float]:
        return self.x, self.y

    @property
    def estimate(self) -> UnicyclePose:
        return UnicyclePose(self.x + self._error[0], self.y + self._error[1], self.heading + self._heading_error)

    @property
    def told(self) -> tuple[float, float]:
        """Where the others believe it is."""
        return self._told[0][:2]

    def step(self) -> None:
        self.speed += max(-ACCELERATION * DT, min(ACCELERATION * DT, self.wanted[0] - self.speed))
        self.turn_rate += max(-TURN_ACCELERATION * DT, min(TURN_ACCELERATION * DT, self.wanted[1] - self.turn_rate))
        self.heading += self.turn_rate * DT
        self.x += self.speed * DT * math.cos(self.heading)
        self.y += self.speed * DT * math.sin(self.heading)
        # Correlated over some 2 s, as a filter's errors are.
        keep = math.exp(-DT / 2.0)
        for axis in range(2):
            noise = self._generator.gauss(0.0, self._sigma * math.sqrt(1 - keep * keep))
            self._error[axis] = keep * self._error[axis] + noise
        self._told.append(self.estimate)


class DrivingWorld:
    """Robots that decide every 0.1 s, each at its own time."""

    def __init__(self, poses: list[UnicyclePose], seed: int, *, sigma: float = 0.025, delay: float = 0.3) -> None:
        generator = random.Random(seed)
        self.bodies = [Body(pose, generator, sigma, delay) for pose in poses]
        self.closest = math.inf
        self.now = 0.0

    def run(
        self,
        seconds: float,
        decide: Callable[[int, UnicyclePose, list[tuple[float, float]]], tuple[float, float]],
        until: Callable[[], bool] = lambda: False,
    ) -> bool:
        """`decide(i, pose, others)` gives speed and turn rate; True where `until` held in time."""
        for step in range(round(seconds / DT)):
            for i, body in enumerate(self.bodies):
                if (step + i) % 5 == 0:
                    others = [other.told for other in self.bodies if other is not body]
                    body.wanted = decide(i, body.estimate, others)
            for body in self.bodies:
                body.step()
            self.now += DT
            places = [body.place for body in self.bodies]
            for i, place in enumerate(places):
                for other in places[:i]:
                    self.closest = min(self.closest, math.dist(place, other))
            if step % 25 == 0 and until():
                return True
        return False
