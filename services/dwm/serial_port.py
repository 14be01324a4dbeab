"""A DWM1001 at a serial port: opens it, polls it, publishes, and tries for ever when either goes away.

What others want of the module (`swarm dwm`) comes over the bus, since the port has one owner.
"""

import os
import select
import termios
from pathlib import Path
from typing import TYPE_CHECKING

from services.dwm.core.module.poller import Answered, ModuleHealth, Poller
from services.dwm.localizer import Localizer
from services.dwm.requests import ModuleRequests
from swarm import clock
from swarm.errors import MissingPackageError
from swarm.process.service import Service

if TYPE_CHECKING:
    import serial

BAUD = 115200
_FIRST_PAUSE = 0.1
_MAX_PAUSE = 2.0
_WRITE_TIMEOUT = 0.1
_MAX_WAIT = 0.2
"""Seconds between looks at whether to stop: a signal does not wake `select`."""


def serve(service: Service, path: Path) -> None:
    """Publish what the module measures until the service is to stop."""
    try:
        import serial
    except ImportError:
        raise MissingPackageError("the serial port of [dwm] source", "pyserial", "lab", "robot") from None
    localizer = Localizer(service, clock.now())
    wake = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
    requests = ModuleRequests(service, lambda: os.eventfd_write(wake, 1))
    pause = _FIRST_PAUSE
    service.ready()  # to serve; how the module does is told from here on
    while not service.stopping.is_set():
        before = service.counters["reports"]
        try:
            # exclusive: two processes polling one module would read each other's answers
            with serial.Serial(str(path), BAUD, timeout=0, write_timeout=_WRITE_TIMEOUT, exclusive=True) as port:
                _poll(service, port, localizer, requests, wake)
        except (OSError, termios.error) as error:  # pyserial's own are OSErrors, but it lets the second one through
            service.counters["port_errors"] += 1
            reason = f"{path}: {(isinstance(error, OSError) and error.strerror) or error}"
            service.degraded(reason)
            requests.fail(reason)
        if service.counters["reports"] > before:
            pause = _FIRST_PAUSE
        service.watchdog()
        service.stopping.wait(pause)
        pause = min(pause * 2, _MAX_PAUSE)


def _poll(service: Service, port: "serial.Serial", localizer: Localizer, requests: ModuleRequests, wake: int) -> None:
    """Runs the poller until the service is to stop; raises `OSError` when the port goes away."""
    poller = Poller(service.config.dwm.rate, clock.now())
    port.reset_input_buffer()
    while not service.stopping.is_set():
        now = clock.now()
        wait = min(max(0.0, poller.next_deadline() - now), _MAX_WAIT)
        readable, _, _ = select.select([port.fileno(), wake], [], [], wait)
        if wake in readable:
            os.eventfd_read(wake)
            for request in requests.new():
                poller.ask(request.ticket, request.request)
        if port.fileno() in readable:
            poller.receive(port.read(4096), clock.now())
        now = clock.now()
        if now >= poller.next_deadline():
            poller.handle_timer(now)
        if data := poller.to_send():
            port.write(data)
        service.watchdog()
        for event in poller.events():
            if isinstance(event, ModuleHealth):
                _tell(service, port.name, event)
            elif isinstance(event, Answered):
                requests.answer(event.ticket, event.answer, event.problem)
            else:
                localizer.report(event.location, now)


def _tell(service: Service, name: str | None, health: ModuleHealth) -> None:
    if health.working:
        service.ready()
    else:
        service.degraded(f"{name}: {health.reason}")
