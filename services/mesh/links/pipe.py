"""A connected stream socket that never waits: one thread reads when select says so, any thread writes under a lock.

The rules come from what RFCOMM sockets do (docs/reference/network/frames.md, sockets): the end of a connection may be
an empty read or any error, and a read after it may never return. So a socket is not read again after either, and a
fault while writing only shuts it down: the reading thread finds out, says why, and closes it. It finds out even where
the socket does not become readable (RFCOMM gives an error once, to whoever comes first).
"""

import contextlib
import socket
from collections.abc import Callable

from services.mesh.core.link.calls import UNKNOWN, Caller

READ_SIZE = 65536


class Pipe:
    """One connection over a stream socket. Subclasses may wrap what is written and delay what is read."""

    def __init__(self, sock: socket.socket, caller: Caller = UNKNOWN) -> None:
        """`caller` is what is known of the other end where it called us."""
        sock.setblocking(False)
        self.caller = caller
        self.limit: Callable[[float], None] | None = None
        """Sets the silence, s, shortly before which the radio ends the connection; None without a radio, or if the
        other end sets it."""
        self._sock = sock
        self._arrived: bytes | None = None
        self._rest = b""
        self._shut = False
        self._over = False
        self._unwritable = False
        self.fault = ""
        """Why reading or writing failed."""

    def fileno(self) -> int:
        return self._sock.fileno()

    # -- the reading thread's side ---------------------------------------------------------------------------

    @property
    def restless(self) -> bool:
        """Whether `wants_read` and `next_change` are to be asked before each wait; else it is read when the socket is
        readable. Once it is, it stays so."""
        return self._unwritable

    def wants_read(self, now: float) -> bool:
        """Return whether `read` is to be called when the socket is readable."""
        return not self._over

    def read(self, now: float) -> None:
        """Take what is there; `take` gives it."""
        self._arrived = self._receive()

    def take(self, now: float) -> bytes | None:
        """Return the bytes that have arrived, b"" at the end of the connection, None when there is nothing now."""
        if self._arrived is None and self._unwritable and not self._over:
            self._arrived = self._receive()
        data, self._arrived = self._arrived, None
        return data

    def next_change(self, now: float) -> float | None:
        """Return the time at which `take` or `wants_read` may change, though nothing is read."""
        return now if self._unwritable and not self._over else None

    def close(self) -> None:
        """Close the descriptor, when nobody can write any more."""
        self._shut = True
        self._sock.close()

    def _receive(self) -> bytes | None:
        """Read once: b"" at the end, for whatever reason; None where nothing was there."""
        try:
            data = self._sock.recv(READ_SIZE)
        except (BlockingIOError, InterruptedError):
            if not self._unwritable:
                return None
            data = b""
        except OSError as error:
            self.fault = self.fault or describe(error)
            data = b""
        self._over = not data
        return data

    def nudge(self) -> None:
        """Have the kernel send what waits to be sent, where it may not do so by itself after another connection has
        ended."""

    # -- the writers' side, under the mesh's lock ------------------------------------------------------------

    def offer(self, data: bytes) -> None:
        """Take bytes to be written; only when `flush` said that nothing is left."""
        self._rest = data

    def flush(self) -> bool:
        """Write what goes without waiting; True when nothing is left, or the connection has ended."""
        while self._rest and not self._shut:
            try:
                count = self._sock.send(self._rest)
            except (BlockingIOError, InterruptedError):
                return False
            except OSError as error:
                self.fault = describe(error)
                self._unwritable = True
                self.shutdown()
                break
            self._rest = self._rest[count:]
        return True

    def shutdown(self) -> None:
        """End the connection, which makes it readable. Harmless when repeated."""
        if not self._shut:
            self._shut = True
            with contextlib.suppress(OSError):
                self._sock.shutdown(socket.SHUT_RDWR)


def describe(error: OSError) -> str:
    """Return a short reason for a lost transport."""
    return (error.strerror or str(error) or type(error).__name__).lower()
