"""What a robot's bus wants of its mesh: values to relay, commands, questions; the same code for virtual time."""

from collections import Counter
from collections.abc import Callable, Sequence
from functools import partial
from typing import Protocol, TypeVar

from services.mesh.core.link.clock import ClockState
from services.mesh.core.overlays.robot_overlays import RobotOverlays
from swarm.bus.protocol import BusLike
from swarm.errors import PayloadError
from swarm.messages import (
    Arm,
    Clock,
    EchoRequest,
    FloodRequest,
    HoldLink,
    Reminder,
    SendRequest,
    Stop,
    TopologyRequest,
    read,
)
from swarm.messages.codec import encode
from swarm.messages.keys import STOP, key

T = TypeVar("T")


class Mesh(Protocol):
    """The mesh that this interface serves; `services.mesh.runner.MeshRunner` documents the methods."""

    def publish(self, source: int, key: str, payload: bytes) -> None:
        """A sample of the own bus."""

    def ask(self, step: Callable[[RobotOverlays, float], object]) -> None:
        """Something for the overlays."""

    def look(self, question: Callable[[RobotOverlays, float], T]) -> T:
        """Something the overlays know."""

    def ping(self, request: EchoRequest) -> None:
        """Measure a link."""

    def hold(self, request: HoldLink) -> None:
        """Have no link with a neighbour for a while."""

    def clock(self) -> ClockState:
        """The mesh clock now."""


class BusInterface:
    """Subscribes and answers queries on the robot's bus for one mesh."""

    def __init__(
        self,
        bus: BusLike,
        robot: str,
        mesh: Mesh,
        relayed: Sequence[str],
        counters: Counter[str],
        tell: Callable[[str], None],
    ) -> None:
        """`relayed`: the key expressions that relay rules name; `tell` hears what is worth a line in the log."""
        self._mesh = mesh
        self._counters = counters
        self._tell = tell
        for source, expression in enumerate(relayed):
            bus.subscribe(expression, partial(mesh.publish, source))
        bus.subscribe([STOP, key(robot, "mesh", "set", "*")], self._obey)

        def serve(topic: str, answer: Callable[[dict[str, str]], object]) -> None:
            bus.serve(key(robot, "mesh", topic), lambda _, asked: encode(answer(asked)))

        serve("members", lambda _: mesh.look(lambda each, now: each.members(now)))
        serve("stopped", lambda _: mesh.look(lambda each, now: each.stopped(now)))
        serve("topology", lambda _: mesh.look(lambda each, now: each.topology(now)))
        serve("clock", lambda _: Clock(*mesh.clock()))
        serve("graph", lambda asked: mesh.look(lambda each, now: each.graph(now, asked.get("after", ""))))

    def _obey(self, key: str, payload: bytes) -> None:
        """A sample of `swarm/stop` or of a key with `set`."""
        try:
            message = read(key, payload)
        except PayloadError as error:
            self._counters["refused_requests"] += 1
            self._tell(f"request refused: {error}")
            return
        match message:
            case FloodRequest() | SendRequest() | Reminder() | TopologyRequest():
                self._mesh.ask(lambda each, now: each.request(message, now))
            case EchoRequest():
                self._mesh.ping(message)
            case HoldLink():
                self._mesh.hold(message)
            case Stop(_, origin, reason):
                self._tell(f"stop of the swarm by={origin} reason={reason}")
                self._mesh.ask(lambda each, now: each.stop(message, now))
            case Arm(_, origin):
                self._tell(f"stops taken back by={origin}")
                self._mesh.ask(lambda each, now: each.arm(now))
