"""The simulated robot as an `I2CBus`: every transfer happens at the time the clock shows, so the body falls in real
time whatever its balancer does."""

from collections.abc import Callable

from sim.core.devices import SimulatedRobot


class SimulatedBus:
    """See `services.balancer.i2c.I2CBus`."""

    def __init__(
        self,
        robot: SimulatedRobot,
        clock: Callable[[], float],
        on_transfer: Callable[[float], None] | None = None,
    ) -> None:
        """`on_transfer(now)` is called after each write: where the truth is told to the world."""
        self.robot = robot
        self._clock = clock
        self._on_transfer = on_transfer
        self._paused = 0.0

    def write(self, address: int, data: bytes) -> None:
        """See `I2CBus`."""
        now = self._clock()
        self.robot.write(address, data, now)
        if self._on_transfer is not None:
            self._on_transfer(now)

    def read(self, address: int, count: int) -> bytes:
        """See `I2CBus`."""
        return self.robot.read(address, count, self._clock())

    def write_read(self, address: int, data: bytes, count: int) -> bytes:
        """See `I2CBus`."""
        now = self._clock()
        self.robot.write(address, data, now)
        return self.robot.read(address, count, now)

    def recover(self) -> None:
        """See `I2CBus`."""
        self.robot.recover(self._clock())

    def pause(self, seconds: float) -> None:
        """See `I2CBus`. Counted only: six robots on a small machine would wake up 1500 times a second for nothing."""
        self._paused += seconds

    def untimed(self) -> float:
        """See `I2CBus`."""
        return self.robot.wire_s() + self._paused

    def close(self) -> None:
        """See `I2CBus`."""
