"""What a robot's bus wants of its mesh: values to relay, commands, questions."""

from collections.abc import Callable
from functools import partial

from services.mesh.core.overlays.robot_overlays import RobotOverlays
from services.mesh.mesh import Mesh
from services.mesh.surroundings import Surroundings
from swarm.errors import PayloadError
from swarm.messages import (
    Arm,
    Clock,
    EchoRequest,
    FloodRequest,
    HoldLink,
    Reminder,
    SendRequest,
    TopologyRequest,
    read,
)
from swarm.messages.codec import encode
from swarm.messages.keys import STOP, key
from swarm.messages.service import stop_of


class BusInterface:
    """Subscribes and answers queries on the robot's bus for one mesh."""

    def __init__(self, surroundings: Surroundings, mesh: Mesh) -> None:
        robot, bus, entry = mesh.robot, surroundings.bus, surroundings.entry
        self._counters = surroundings.counters
        self._log = surroundings.log
        self._ask, self._ping, self._hold = entry(mesh.ask), entry(mesh.ping), entry(mesh.hold)
        look, clock = entry(mesh.look), entry(mesh.clock)
        for source, expression in enumerate(mesh.subscriptions):
            bus.subscribe(expression, entry(partial(mesh.publish, source)))
        bus.subscribe(STOP, lambda _, payload: self._stop(payload))
        bus.subscribe(key(robot, "mesh", "set", "*"), self._obey)

        def serve(topic: str, answer: Callable[[dict[str, str]], object]) -> None:
            bus.serve(key(robot, "mesh", topic), lambda _, asked: encode(answer(asked)))

        def asked(topic: str, question: Callable[[RobotOverlays, float], object]) -> None:
            serve(topic, lambda _: look(question))

        asked("members", lambda each, now: each.members(now))
        asked("stopped", lambda each, now: each.stopped(now))
        asked("topology", lambda each, now: each.topology(now))
        serve("clock", lambda _: Clock(*clock()))
        serve("graph", lambda asked: look(lambda each, now: each.graph(now, asked.get("after", ""))))

    def _stop(self, payload: bytes) -> None:
        """Obey a sample of `swarm/stop`, whatever it holds, also one that was published under a wildcard."""
        stop = stop_of(payload)
        self._ask(lambda each, now: each.stop(stop, now))
        self._log.warning("stop of the swarm by=%s reason=%s", stop.origin, stop.reason)

    def _obey(self, key: str, payload: bytes) -> None:
        """Obey a sample of a key with `set`."""
        try:
            message = read(key, payload)
        except PayloadError as error:
            self._counters["refused_requests"] += 1
            self._log.warning("request refused: %s", error)
            return
        match message:
            case FloodRequest() | SendRequest() | Reminder() | TopologyRequest():
                self._ask(lambda each, now: each.request(message, now))
            case EchoRequest():
                self._ping(message)
            case HoldLink():
                self._hold(message)
            case Arm(_, origin, age):
                self._log.warning("stops taken back by=%s", origin)
                self._ask(lambda each, now: each.arm(now, age))
