"""Ways to speak with one module from a command: a serial port of this machine, or a robot's dwm service.

The service owns its port, so that requests to a robot's module go over its bus, each named by a ticket.
"""

import errno
import os
import queue
import select
import termios
from collections.abc import Callable
from pathlib import Path
from typing import Protocol, TypeVar

from services.dwm.core.module import calls, shell
from services.dwm.core.module.exchange import SLOW_TIMEOUT, TIMEOUT, Answer, ModuleExchange, Trouble
from services.dwm.core.module.tlv import ModuleCall
from swarm import clock
from swarm.bus.zenoh_bus import Bus
from swarm.errors import LocalError, MissingPackageError, RemoteError
from swarm.messages import ModuleAnswer, ModuleRequest
from swarm.messages.codec import decoded
from swarm.messages.keys import key

T = TypeVar("T")

BAUD = 115200

_ATTEMPTS = 3
"""Tries for each call, since a byte may get lost on the wire."""

_REPEAT = 1.0
"""Seconds after which a request over the bus is published again; longer than any answer takes."""

_PATIENCE = 4.0
"""Seconds to wait for an answer over the bus."""


class NoAnswerError(RemoteError):
    """The module, or the way to it, gave no proper answer."""

    def __init__(self, trouble: Trouble) -> None:
        super().__init__(trouble.reason)
        self.trouble = trouble


class ModuleConnection(Protocol):
    """Something a module hangs on."""

    name: str

    def ask(self, call: ModuleCall[T]) -> T:
        """Return the answer; raises `NoAnswerError`."""

    def close(self) -> None:
        """Release the module."""


def _persist(exchange: Callable[[], Answer[T] | Trouble], before_retry: Callable[[Trouble], None] | None = None) -> T:
    """Return the answer of the first of a few exchanges that has one; a request that is refused is not repeated.

    `before_retry(trouble)` is called between two of them. Raises `NoAnswerError` with the last trouble.
    """
    outcome = exchange()
    for _ in range(_ATTEMPTS - 1):
        if isinstance(outcome, Answer) or outcome.kind.startswith("refused"):
            break
        if before_retry is not None:
            before_retry(outcome)
        outcome = exchange()
    if isinstance(outcome, Trouble):
        raise NoAnswerError(outcome)
    return outcome.result


class PortLine:
    """A module at a serial port of this machine. A module in shell mode is told to leave it."""

    def __init__(self, path: str) -> None:
        """Raises `LocalError` where the port cannot be opened."""
        try:
            import serial
        except ImportError:
            raise MissingPackageError("a serial port", "pyserial", "lab", "robot") from None
        self.name = path
        try:
            # exclusive: two processes at one module would read each other's answers
            self._port: serial.Serial = serial.Serial(path, BAUD, timeout=0, write_timeout=1.0, exclusive=True)
        except OSError as error:
            hint = "; a service owns it: ask the robot, without --port" if "lock" in str(error) else ""
            if error.errno == errno.EACCES:
                hint = "; is this user in the group dialout?"
            # pyserial's own text repeats the path and the number
            raise LocalError(f"{path}: {os.strerror(error.errno) if error.errno else error}{hint}") from None

    def ask(self, call: ModuleCall[T]) -> T:
        def leave_shell(trouble: Trouble) -> None:
            if trouble.kind != "layout":
                for _ in range(shell.LEAVE_TIMES):
                    self._exchange(ModuleCall("leave the shell", shell.LEAVE, (), lambda _: None), TIMEOUT)

        return _persist(lambda: self._exchange(call), leave_shell)

    def close(self) -> None:
        self._port.close()

    def _exchange(self, call: ModuleCall[T], timeout: float = SLOW_TIMEOUT) -> Answer[T] | Trouble:
        exchange = ModuleExchange(call)
        end = clock.now() + timeout
        try:
            self._port.reset_input_buffer()
            self._port.write(call.request)
            while (left := end - clock.now()) > 0:
                if select.select([self._port.fileno()], [], [], left)[0]:
                    outcome = exchange.receive(self._port.read(4096))
                    if outcome is not None:
                        return outcome
        except (OSError, termios.error) as error:  # the port went away; pyserial lets the second one through
            return Trouble("silent", f"{self.name}: {error}")
        return exchange.expire()


class BusLine:
    """A robot's module, through its dwm service."""

    def __init__(self, robot: str, directory: Path) -> None:
        self.name = robot
        self._answers: queue.SimpleQueue[ModuleAnswer] = queue.SimpleQueue()
        self._prefix = os.urandom(6).hex()
        self._count = 0
        self._key = key(robot, "dwm", "set", "module")
        self.bus = Bus.of(directory)
        # What is no answer, only a broken service could have sent.
        self.bus.subscribe(key(robot, "dwm", "module"), decoded(ModuleAnswer, self._answers.put))

    def ask(self, call: ModuleCall[T]) -> T:
        if not self.bus.wait_connected(_PATIENCE):
            raise NoAnswerError(Trouble("silent", f"{self.name}: its bus does not answer: does it run?"))
        return _persist(lambda: self._exchange(call))

    def close(self) -> None:
        self.bus.close()

    def _exchange(self, call: ModuleCall[T]) -> Answer[T] | Trouble:
        """Return what the module said to the service, or why it said nothing; raises `NoAnswerError` where that is
        silent."""
        self._count += 1
        request = ModuleRequest(f"{self._prefix}-{self._count}", call.request)
        end = clock.now() + _PATIENCE
        while clock.now() < end:
            self.bus.publish(self._key, request, urgent=True)
            answer = self._wait(request.ticket, min(end, clock.now() + _REPEAT))
            if answer is not None:
                return _read(call, answer)
        reason = f"{self.name}: its dwm service does not answer: does it run, and is its source no recording?"
        raise NoAnswerError(Trouble("silent", reason))

    def _wait(self, ticket: str, end: float) -> ModuleAnswer | None:
        while (left := end - clock.now()) > 0:
            try:
                answer = self._answers.get(timeout=left)
            except queue.Empty:
                return None
            if answer.ticket == ticket:
                return answer
        return None


def _read(call: ModuleCall[T], answer: ModuleAnswer) -> Answer[T] | Trouble:
    exchange = ModuleExchange(call)
    outcome = exchange.receive(answer.answer) or exchange.expire()
    if isinstance(outcome, Trouble) and (not answer.answer or outcome.kind == "silent"):
        return Trouble("silent", answer.problem or outcome.reason)
    return outcome


def restart(line: ModuleConnection, patience: float = 6.0) -> None:
    """Reset the module and wait until it is there again; raises `NoAnswerError` where it is not."""
    line.ask(calls.RESET)
    end = clock.now() + patience
    while True:
        try:
            if line.ask(calls.STATUS_GET) is not None:
                return
        except NoAnswerError:
            if clock.now() >= end:
                raise
