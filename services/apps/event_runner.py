"""An event-driven or periodic app between packed bytes: a `HandlerCall` of the core calls the author's handler.

No IO and no clock. Whatever the author's code raises comes out as one `AppError` that names robot, step, file, line and
fault.
"""

import hashlib
from collections.abc import Mapping, Sequence
from typing import Any

from services.apps.runner import AppRunner
from swarm.app.event_app import EventApp, PeriodicApp
from swarm.core.asynchronous import HandlerCall, NeighbourState
from swarm.core.graph import Graph
from swarm.errors import AppError, FrameError, shown
from swarm.messages.codec import Value

HANDLERS = ("on_button", "on_message", "on_answer", "on_announced", "on_neighbour", "on_timer")
"""The handlers that are only called where the app has them."""


class EventRunner(AppRunner):
    """Drives one app instance from event to event."""

    app: EventApp

    def __init__(self, app: EventApp, source: str) -> None:
        """`source`: path of the app's file; a fault is reported with the line in it."""
        super().__init__(app, source)
        kind = type(app)
        self.handled = frozenset(name for name in HANDLERS if getattr(kind, name) is not getattr(EventApp, name))
        """Handlers that the app has of its own."""
        self.unreadable = 0
        """States of neighbours that could not be unpacked."""
        self._changes: dict[str, Value] = {}
        self._graph: Graph | None = None
        self._calls = 0

    @property
    def period(self) -> float | None:
        """s between two steps; None where the app has none."""
        return self.app.period if isinstance(self.app, PeriodicApp) else None

    @property
    def finished(self) -> bool:
        """Whether the app has said that its work is done."""
        return self.app.finished is not None

    def change(self, values: Mapping[str, object]) -> list[str]:
        """Other values for parameters, for the next handler on; `AppError` where one cannot be changed so, and then
        none is. Returns their names: `on_parameter` is to be called with each."""
        found = type(self.app).check_change(values)
        self._changes = {**self._changes, **found}
        return list(found)

    def move(self, graph: Graph) -> None:
        """Other links are in force, from the next handler on: neighbours and weights follow from them."""
        self._graph = graph

    def call(self, call: HandlerCall, k: int, known: Sequence[NeighbourState]) -> bytes:
        """Let the app handle an event at step `k`; returns its state, packed. Takes as long as the author's code does.

        `known` are the neighbours' newest states.
        """
        self._be_at(k)
        app = self.app
        where = place_of(call, k)
        self._calls += 1
        app.robot.prepare(f"{self._calls}", None)
        graph, self._graph = self._graph, None
        if graph is not None:
            app.robot.graph = graph
        changes, self._changes = self._changes, {}
        if changes or graph is not None:
            self._call(where, lambda: app.change(changes))
        views = self._views(known)
        object.__setattr__(app, "neighbours", tuple(views.values()))
        arguments: Sequence[object] = call.arguments
        if call.handler == "step":
            app.robot.begin_step(k)
            arguments = (list(views.values()),)
        elif call.handler == "on_neighbour":
            arguments = [views[name] for name in call.arguments if name in views]
            if not arguments:
                return self._packed(where, call.handler)
        answer: object = self._call(where, lambda: getattr(app, call.handler)(*arguments), call.handler)
        if answer is not None:
            text = f"it returned {shown(answer)}; a handler assigns to the state instead"
            raise self._fault(where, call.handler, text)
        return self._packed(where, call.handler)

    def _views(self, known: Sequence[NeighbourState]) -> dict[Any, Any]:
        view, unpack = type(self.app).spec.view, self.schema.unpack
        views = {}
        for name, data, age in known:
            try:
                views[name] = view(name, *unpack(data), age)
            except FrameError:
                self.unreadable += 1
        return views

    def _packed(self, where: str, method: str) -> bytes:
        names = self.schema.names
        try:
            own = self.schema.pack({name: getattr(self.app, name) for name in names})
        except AppError as error:
            raise self._fault(where, method, str(error)) from None
        # What others see is what we go on with: float32 rounds, numbers become floats, lists tuples.
        self._set(own)
        return own


def version(app: EventApp, digest: bytes) -> int:
    """u32 over what robots must have in common to understand each other: state, source of the app, names of the
    robots."""
    text = f"{type(app).spec.schema.hash:08x} {digest.hex()} {' '.join(app.robot.swarm)}"
    return int.from_bytes(hashlib.blake2b(text.encode(), digest_size=4).digest(), "little")


def place_of(call: HandlerCall, k: int) -> str:
    """Describe a call by handler and step."""
    return f"step {k}" if call.handler == "step" else f"{call.handler}() at k = {k}"
