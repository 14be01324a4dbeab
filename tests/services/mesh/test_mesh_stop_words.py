"""What a mesh tells its own bus of stops, and when: balancers wait for it."""

from services.mesh.core.overlays.stop import STOP_PERIOD, Register, Stops
from swarm.messages import Stop, Stopped, read


class NoFlood:
    """Takes what is flooded, and keeps nothing."""

    def publish(self, *_: object, **__: object) -> None: ...


class Bus:
    """The bus of a robot, with its mesh's part that tells of stops."""

    def __init__(self) -> None:
        self.now = 100.0
        self.heard: list[Stop | Stopped] = []
        robots = frozenset(("r0", "r1"))
        self.register = Register("r0", lambda: 7, robots, emit=lambda _: None, changed=self._changed)
        self.stops = Stops("r0", self.register, NoFlood(), self._take)  # type: ignore[arg-type]

    def _changed(self) -> None:
        self.stops.changed(self.now)

    def _take(self, key: str, payload: bytes, _: int) -> None:
        message = read(key, payload)
        assert isinstance(message, Stop | Stopped)
        self.heard.append(message)

    def run(self, seconds: float) -> list[bool]:
        """Let time pass; return what was told on `mesh/stopped`."""
        end = self.now + seconds
        while (due := self.stops.next_deadline()) <= end:
            self.now = max(self.now, due)
            self.stops.handle_timer(self.now)
        self.now = end
        told, self.heard = [each.stopped for each in self.heard if isinstance(each, Stopped)], []
        return told


def test_a_mesh_tells_once_at_its_start_that_it_knows_of_no_stop() -> None:
    bus = Bus()
    assert bus.run(10.0) == [False]
    assert bus.run(10.0) == []


def test_a_stop_is_told_each_second_until_it_is_taken_back() -> None:
    bus = Bus()
    bus.run(1.0)
    bus.register.stop("enough", bus.now)
    assert sum(isinstance(each, Stop) for each in bus.heard) == 1
    assert bus.run(3.0 * STOP_PERIOD) == [True] * 4
    bus.register.arm(bus.now)
    assert bus.run(10.0) == [False]
