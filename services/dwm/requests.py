"""Requests to the module that come over the bus (`dwm/set/module`), and their answers (`dwm/module`).

A request is named by its ticket and repeated by whoever asks until the answer is there, since the bus may lose messages:
the one under way is not done twice, and the last ones are answered again from memory.
"""

import os
import queue
from collections import OrderedDict

from swarm import clock
from swarm.codec import decode
from swarm.errors import PayloadError
from swarm.keys import key
from swarm.messages import ModuleAnswer, ModuleRequest
from swarm.service import Service

MAX_OPEN = 16
"""Tickets remembered."""

MAX_REQUEST = 255
"""Bytes: type, length and at most 253 of value."""


class Requests:
    """What is asked for and not yet answered. `fileno` is readable when there is something to take."""

    def __init__(self, service: Service) -> None:
        self._service = service
        self._queue: queue.SimpleQueue[ModuleRequest] = queue.SimpleQueue()
        self._answers: OrderedDict[str, ModuleAnswer | None] = OrderedDict()
        self._key = key(service.robot, "dwm", "module")
        self._wake = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        service.bus.subscribe(key(service.robot, "dwm", "set", "module"), self._take)

    def fileno(self) -> int:
        """For `select`."""
        return self._wake

    def new(self) -> list[ModuleRequest]:
        """What came since the last call."""
        try:
            os.eventfd_read(self._wake)
        except BlockingIOError:
            return []
        return [self._queue.get_nowait() for _ in range(self._queue.qsize())]

    def answer(self, ticket: str, data: bytes, problem: str) -> None:
        """Publish what the module said."""
        message = ModuleAnswer(clock.now(), ticket, data, problem)
        if ticket in self._answers:
            self._answers[ticket] = message
        self._service.bus.publish(self._key, message)

    def _take(self, name: str, payload: bytes) -> None:
        """Runs on Zenoh's thread."""
        try:
            request = decode(ModuleRequest, payload, name)
        except PayloadError as error:
            self._service.counters["refused_payloads"] += 1
            self._service.log.debug("%s", error)
            return
        if request.ticket in self._answers:
            known = self._answers[request.ticket]
            if known is not None:
                self._service.bus.publish(self._key, known)
            return
        if len(request.request) > MAX_REQUEST:
            self._service.counters["refused_payloads"] += 1
            return
        self._answers[request.ticket] = None
        if len(self._answers) > MAX_OPEN:
            self._answers.popitem(last=False)
        self._queue.put(request)
        os.eventfd_write(self._wake, 1)
