"""The swarm's common time, as apps and services use it: `MeshClock(bus, robot).now()`.

The mesh service relates the robots' monotonic clocks and publishes the relation once a second (docs/reference/keys.md,
Clock); here it is applied. No time server is needed, and mesh time has nothing to do with the time of day.
"""

import logging

from swarm import clock
from swarm.bus.protocol import BusLike, Now
from swarm.errors import PayloadError
from swarm.messages import Clock
from swarm.messages.codec import decode
from swarm.messages.keys import key

_log = logging.getLogger("mesh_clock")


def mesh_time(state: Clock, monotonic: float) -> float:
    """Mesh time at a time of the robot's monotonic clock, s."""
    return monotonic + state.offset + state.rate * (monotonic - state.t)


def monotonic_time(state: Clock, mesh: float) -> float:
    """Return the robot's monotonic clock when it will be (or was) that mesh time, s: for deadlines."""
    return (mesh - state.offset + state.rate * state.t) / (1.0 + state.rate)


class MeshClock:
    """Reads one robot's mesh clock from its bus."""

    def __init__(self, bus: BusLike, robot: str, now: Now = clock.now) -> None:
        """`now` is the robot's monotonic clock."""
        self._monotonic = now
        self._key = key(robot, "mesh", "clock")
        self.state: Clock | None = None
        """The newest message; None until the first has come, as soon as the mesh is there."""
        self._bus = bus
        bus.subscribe(self._key, self._receive)
        bus.on_change(self._on_bus)

    def now(self) -> float | None:
        """Mesh time, s; None as long as the mesh has not told it. Where the mesh has died, its last word holds on."""
        state = self.state
        return None if state is None else mesh_time(state, self._monotonic())

    @property
    def error(self) -> float | None:
        """Estimated standard deviation of `now` from the root's clock, s; None like `now`. Where links take longer one
        way than the other, half of the difference comes on top, which nobody can see."""
        return None if self.state is None else self.state.error

    @property
    def root(self) -> str | None:
        """The robot whose clock it is. Robots with the same root have the same mesh time, others not."""
        return None if self.state is None else self.state.root

    def monotonic(self, mesh: float) -> float | None:
        """Return the robot's monotonic time at which the mesh clock shows `mesh`; None while the mesh clock is
        unknown."""
        state = self.state
        return None if state is None else monotonic_time(state, mesh)

    def _on_bus(self, connected: bool) -> None:
        if connected:
            self._bus.ask(self._key, self._receive)

    def _receive(self, key: str, payload: bytes) -> None:
        try:
            self.state = decode(Clock, payload, key)
        except PayloadError as error:
            _log.warning("%s", error)
