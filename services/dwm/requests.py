"""Requests to the module that come over the bus (`dwm/set/module`), and their answers (`dwm/module`).

A request is named by its ticket and repeated by whoever asks until the answer is there, since the bus may lose
messages. The last ones are answered again from memory, so that nothing is done twice.
"""

import queue
import threading
from collections import OrderedDict
from collections.abc import Callable

from swarm import clock
from swarm.messages import ModuleAnswer, ModuleRequest
from swarm.messages.keys import key
from swarm.process.runtime import listen, refuse
from swarm.process.service import Service

MAX_OPEN = 16
"""Tickets remembered, and requests that may wait to be taken."""

MAX_REQUEST = 255
"""Bytes: type, length and at most 253 of value."""


class ModuleRequests:
    """The requests that have no answer yet."""

    def __init__(self, service: Service, wake: Callable[[], None], *, repeats: bool = False) -> None:
        """`wake()` is called on Zenoh's thread when there is something to take. With `repeats` a request that is
        repeated before its answer is there comes again: for one who passes it on over the bus."""
        self._service = service
        self._wake = wake
        self._repeats = repeats
        self._queue: queue.SimpleQueue[ModuleRequest] = queue.SimpleQueue()
        self._answers: OrderedDict[str, ModuleAnswer | None] = OrderedDict()
        self._lock = threading.Lock()
        """A lock around the answers: Zenoh's thread and the service's own use them."""
        self._key = key(service.robot, "dwm", "module")
        listen(service, key(service.robot, "dwm", "set", "module"), ModuleRequest, self._take)

    def new(self) -> list[ModuleRequest]:
        """Return the requests since the last call."""
        return [self._queue.get_nowait() for _ in range(self._queue.qsize())]

    def answer(self, ticket: str, data: bytes, problem: str) -> None:
        """Publish what the module said; nothing where nobody has asked here."""
        with self._lock:
            if ticket not in self._answers:
                return
            message = self._answers[ticket] = ModuleAnswer(clock.now(), ticket, data, problem)
        self._service.bus.publish(self._key, message)

    def fail(self, problem: str) -> None:
        """Answer everything that is open: the module is gone."""
        self.new()
        with self._lock:
            opened = [ticket for ticket, answer in self._answers.items() if answer is None]
        for ticket in opened:
            self.answer(ticket, b"", problem)

    def _take(self, request: ModuleRequest) -> None:
        """Runs on Zenoh's thread."""
        if len(request.request) > MAX_REQUEST:
            refuse(self._service, f"a request of {len(request.request)} bytes: at most {MAX_REQUEST} are taken")
            return
        full = self._queue.qsize() >= MAX_OPEN
        with self._lock:
            is_new = request.ticket not in self._answers
            if is_new and full:  # whoever asks repeats it
                refuse(self._service, f"request {request.ticket}: {MAX_OPEN} others wait")
                return
            known = self._answers.setdefault(request.ticket, None)
            if len(self._answers) > MAX_OPEN:
                self._answers.popitem(last=False)
        if known is not None:
            self._service.bus.publish(self._key, known)
        elif is_new or (self._repeats and not full):
            self._queue.put(request)
            self._wake()
