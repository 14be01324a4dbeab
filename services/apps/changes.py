"""An app's parameters on the bus: told, and changed by request while the app runs.

A changed value holds for the process. One that is started again begins with the values of swarm.toml and its command.
"""

from collections.abc import Callable, Mapping
from typing import Protocol

from swarm import clock
from swarm.app import App
from swarm.bus_protocol import BusLike, Clock
from swarm.codec import Value, decode, encode
from swarm.errors import AppError, PayloadError
from swarm.keys import key
from swarm.messages import AppParameter, AppParameters, AppParametersSet, SetAppParameters


class Refuse(Protocol):
    """What is told of requests that are none."""

    def __call__(self, error: PayloadError) -> None:
        """`error` names key and field."""


class Changes:
    """Answers for one app on one robot."""

    def __init__(
        self,
        bus: BusLike,
        robot: str,
        name: str,
        app: App,
        change: Callable[[Mapping[str, Value]], None],
        refuse: Refuse,
        now: Clock = clock.now,
    ) -> None:
        """`change(values)` takes new values or raises `AppError`; it runs on the bus's thread."""
        self._bus = bus
        self._robot = robot
        self._name = name
        self._app = app
        self._change = change
        self._refuse = refuse
        self._now = now
        self._answers: dict[str, AppParametersSet] = {}
        self._key = key(robot, f"app/{name}", "parameters")
        bus.serve(self._key, lambda *_: encode(self._message()))
        bus.subscribe(key(robot, f"app/{name}", "set", "parameters"), self._on_set)

    def tell(self) -> None:
        """Publish the parameters as they are now: after a change."""
        self._bus.publish(self._key, self._message())

    def _message(self) -> AppParameters:
        app = self._app
        return AppParameters(
            self._now(),
            {
                name: AppParameter(getattr(app, name), declared.unit, declared.expected(), bool(declared.live))
                for name, declared in type(app).spec.parameters.items()
            },
        )

    def _on_set(self, name: str, payload: bytes) -> None:
        try:
            request = decode(SetAppParameters, payload, name)
        except PayloadError as error:
            self._refuse(error)
            return
        problem = ""
        try:
            self._change(request.parameters)
        except AppError as error:
            problem = f"app {self._name} on {self._robot}: {error}"
        answer = AppParametersSet(self._now(), request.ticket, problem)
        self._bus.publish(key(self._robot, f"app/{self._name}", "parameters_set"), answer)
