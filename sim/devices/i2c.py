"""The simulated robot as an `I2CBus`: every transfer happens at the time the clock shows, so the body falls in real
time whatever its balancer does."""

from collections.abc import Callable

from services.balancer.i2c import NOBODY
from sim.core.devices import SimulatedRobot


class SimulatedBus:
    """The simulated bus of `services.balancer.i2c.I2CBus`."""

    def __init__(
        self,
        robot: SimulatedRobot,
        clock: Callable[[], float],
        on_transfer: Callable[[float], None] | None = None,
        *,
        take: Callable[[float], None] | None = None,
    ) -> None:
        """`on_transfer(now)` is called after each write, and tells the truth to the world.

        `take(seconds)` lets the time pass that a transfer or a pause takes. Without it that time is counted only: six
        robots on a small machine would wake up 1500 times a second for nothing.
        """
        self.robot = robot
        self._clock = clock
        self._on_transfer = on_transfer
        self._take = take
        self._paused = 0.0

    def write(self, address: int, data: bytes) -> None:
        self._pass(address, len(data))  # devices obey at the STOP
        now = self._clock()
        self.robot.write(address, data, now)
        if self._on_transfer is not None:
            self._on_transfer(now)

    def read(self, address: int, count: int) -> bytes:
        try:
            return self.robot.read(address, count, self._clock())
        finally:
            self._pass(address, count)

    def write_read(self, address: int, data: bytes, count: int) -> bytes:
        self._pass(address, len(data))
        now = self._clock()
        self.robot.write(address, data, now)
        try:
            return self.robot.read(address, count, now)
        finally:
            self._pass(address, count)

    def recover(self) -> None:
        self.robot.recover(self._clock())
        self._pass(NOBODY, 1)

    def pause(self, seconds: float) -> None:
        if self._take is None:
            self._paused += seconds
        else:
            self._take(seconds)

    def untimed(self) -> float:
        return 0.0 if self._take is not None else self.robot.wire_s() + self._paused

    def close(self) -> None:
        """See `I2CBus`."""

    def _pass(self, address: int, count: int) -> None:
        """Let the time of a transfer pass."""
        if self._take is not None:
            self._take(self.robot.transfer_s(address, count))
