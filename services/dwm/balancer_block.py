"""A DWM1001 that is wired to the ATmega32U4: reports come over the bus from the balancer, requests go there."""

import contextlib
import queue

from services.dwm.core.module.block import Block
from services.dwm.core.module.calls import call_of
from services.dwm.core.module.poller import ModuleHealth
from services.dwm.localizer import Localizer
from services.dwm.requests import ModuleRequests
from swarm import clock
from swarm.errors import FrameError
from swarm.messages import ModuleAnswer, Uwb
from swarm.messages.keys import key
from swarm.process.runtime import listen, refuse
from swarm.process.service import Service

_POLL = 0.25
"""Seconds between two checks whether to stop: a signal does not wake a waiting queue."""
MAX_WAITING = 100
"""The most messages that wait to be taken."""


def serve(service: Service) -> None:
    """Publish what the ATmega hears of the module until the service is to stop."""
    arrived = arrivals(service)

    def wake() -> None:
        with contextlib.suppress(queue.Full):  # what waits wakes as well
            arrived.put_nowait(None)

    requests = ModuleRequests(service, wake, repeats=True)
    block, localizer = Block(clock.now()), Localizer(service, clock.now())
    service.ready()
    while not service.stopping.is_set():
        try:
            message = arrived.get(timeout=_POLL)
        except queue.Empty:
            message = None
        now = clock.now()
        _pass_on(service, requests)
        if isinstance(message, ModuleAnswer):
            requests.answer(message.ticket, message.answer, message.problem)
            continue
        for event in block.handle_timer(now) if message is None else block.receive(message, now):
            if isinstance(event, ModuleHealth) and event.working:
                service.ready()
            elif isinstance(event, ModuleHealth):
                service.degraded(event.reason)
            else:
                localizer.report(event.location, now - event.age)
        service.watchdog()


def arrivals(service: Service) -> "queue.Queue[Uwb | ModuleAnswer | None]":
    """Return the queue of what the balancer says of the module, in which at most `MAX_WAITING` messages wait."""
    arrived: queue.Queue[Uwb | ModuleAnswer | None] = queue.Queue(MAX_WAITING)

    def take(message: Uwb | ModuleAnswer) -> None:
        try:
            arrived.put_nowait(message)
        except queue.Full:
            refuse(service, f"{MAX_WAITING} messages of the balancer wait")

    listen(service, key(service.robot, "balancer", "uwb"), Uwb, take)
    listen(service, key(service.robot, "balancer", "module"), ModuleAnswer, take)
    return arrived


def _pass_on(service: Service, requests: ModuleRequests) -> None:
    """Requests go to the balancer under the same ticket; only calls that are let through."""
    for request in requests.new():
        try:
            call_of(request.request)
        except FrameError as error:
            requests.answer(request.ticket, b"", str(error))
        else:
            service.bus.publish(key(service.robot, "balancer", "set", "module"), request)
