"""Messages beyond the neighbours in a rehearsal: nothing is lost, everybody is reached."""

from collections.abc import Callable, Sequence

from swarm.app.overlays import ITSELF, Message, check_payload
from swarm.frozen import frozen
from swarm.messages import Flooded, Sent

Deliver = Callable[[str, Message], None]


@frozen
class Request:
    """A flood or a message under way, as an app sees it; its answer comes by `robot.answer`, or `on_answer`."""

    ticket: str


class RehearsalOverlays:
    """A replacement of `swarm.app.overlays.Overlays` on one robot."""

    def __init__(self, robot: str, swarm: Sequence[str], deliver: Deliver) -> None:
        """`deliver(to, message)` brings a message to another robot."""
        self.used = False
        """Whether the app has sent or looked for messages: its state may then depend on when they come."""
        self._robot = robot
        self._others = tuple(name for name in swarm if name != robot)
        self._deliver = deliver
        self._count = 0
        self._inbox: list[Message] = []
        self._answers: dict[str, Flooded | Sent] = {}

    def flood(self, payload: bytes, **_: object) -> Request:
        check_payload(payload)
        for name in self._others:
            self._deliver(name, Message(self._robot, payload, flooded=True))
        ticket = self._next()
        self._answers[ticket] = Flooded(0.0, ticket, "app", self._others, True, "")
        return Request(ticket)

    def send(self, to: str, payload: bytes, **_: object) -> Request:
        check_payload(payload)
        if known := to in self._others:
            self._deliver(to, Message(self._robot, payload, flooded=False))
        ticket = self._next()
        problem = "" if known else ITSELF if to == self._robot else f"there is no robot {to}"
        self._answers[ticket] = Sent(0.0, ticket, "app", to, known, problem)
        return Request(ticket)

    def answer(self, ticket: str) -> Flooded | Sent | None:
        return self._answers.get(ticket)

    def messages(self) -> list[Message]:
        self.used = True
        found, self._inbox = self._inbox, []
        return found

    def receive(self, message: Message) -> None:
        """Take a message of another robot."""
        self._inbox.append(message)

    def _next(self) -> str:
        self.used = True
        self._count += 1
        return f"{self._robot}-{self._count}"
