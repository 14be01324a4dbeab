"""A request to the module and its result: an answer, or a named trouble with what to do about it."""

from typing import Generic, TypeVar

from services.dwm.core.module import shell
from services.dwm.core.module.tlv import LayoutError, ModuleCall, Refusal, TlvDecoder
from swarm.errors import FrameError
from swarm.frozen import frozen

T_co = TypeVar("T_co", covariant=True)

TIMEOUT = 0.100
"""Seconds to wait for an answer (API guide: one request at a time; the module answers within 100 ms)."""

SLOW_TIMEOUT = 0.500
"""Seconds for calls that write the module's flash."""

RESTART = 1.5
"""The most seconds for which a module does not answer after `reset`; usually about one."""

_HEARD = 512
"""Number of bytes that are kept to recognise the sender."""

_READABLE = frozenset(b"\t\r\n" + bytes(range(0x20, 0x7F)))


@frozen
class Answer(Generic[T_co]):
    """The module did what it was asked."""

    result: T_co
    raw: bytes


@frozen
class Trouble:
    """The module did not do what it was asked."""

    kind: str
    """silent, garbled, shell, layout or refused."""
    reason: str
    """What is wrong and what to do."""
    raw: bytes = b""
    """The bytes that arrived instead of an answer."""


class ModuleExchange(Generic[T_co]):
    """Feed `receive` until it gives an outcome; call `expire` when the time is over."""

    def __init__(self, call: ModuleCall[T_co]) -> None:
        self.call = call
        self.wrong_frames = 0
        self._decoder = TlvDecoder(call)
        self._heard = bytearray()
        self._error: FrameError | None = None

    def receive(self, data: bytes) -> Answer[T_co] | Trouble | None:
        """Take bytes from the line, in pieces of any size; return None as long as the answer is not there."""
        self._heard += data[: _HEARD - len(self._heard)]
        self._decoder.receive(data)
        while True:
            try:
                answer = self._decoder.next()
            except FrameError as error:
                self.wrong_frames += 1
                # The first one tells what is wrong, later ones come from its pieces.
                self._error = self._error or error
                continue
            if isinstance(answer, Refusal):
                return Trouble("refused", f"it refuses {self.call.name}: {answer.name}", self._decoder.raw)
            if self._decoder.raw:
                return Answer(answer, self._decoder.raw)  # type: ignore[arg-type]
            return None

    def expire(self) -> Trouble:
        """Return the trouble of a call without an answer in time: what came in its place."""
        heard = bytes(self._heard)
        if not heard:
            return Trouble("silent", "it does not answer: is it wired, powered, and a DWM1001 with PANS?")
        if is_shell(heard):
            return Trouble(
                "shell", "it is in shell mode instead of generic mode; quit leaves it, and is sent to it", heard
            )
        if isinstance(self._error, LayoutError):
            return Trouble(
                "layout",
                f"its firmware answers in another layout ({self._error}): PANS R2, version 1.3, is spoken here; "
                "see `swarm dwm info`, flash the module",
                heard,
            )
        hint = f" ({self._error})" if self._error else ""
        return Trouble("garbled", f"its answers are garbled{hint}: wrong baud rate (115200), or a bad wire?", heard)


def is_shell(heard: bytes) -> bool:
    """Return whether this is the text of a module in shell mode."""
    if shell.PROMPT in heard:
        return True
    readable = sum(byte in _READABLE for byte in heard)
    return len(heard) >= 8 and readable >= 0.95 * len(heard)
