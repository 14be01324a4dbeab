"""A DWM1001 that is wired to the ATmega32U4: reports come over the bus from the balancer, requests go there."""

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
from swarm.process.runtime import listen
from swarm.process.service import Service

_POLL = 0.25
"""Seconds between two checks whether to stop: a signal does not wake a waiting queue."""


def serve(service: Service) -> None:
    """Publish what the ATmega hears of the module until the service is to stop."""
    arrived: queue.SimpleQueue[Uwb | ModuleAnswer | None] = queue.SimpleQueue()

    listen(service, key(service.robot, "balancer", "uwb"), Uwb, arrived.put)
    listen(service, key(service.robot, "balancer", "module"), ModuleAnswer, arrived.put)
    requests = ModuleRequests(service, lambda: arrived.put(None), repeats=True)
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


def _pass_on(service: Service, requests: ModuleRequests) -> None:
    """Requests go to the balancer under the same ticket; only calls that are let through."""
    for request in requests.new():
        try:
            call_of(request.request)
        except FrameError as error:
            requests.answer(request.ticket, b"", str(error))
        else:
            service.bus.publish(key(service.robot, "balancer", "set", "module"), request)
