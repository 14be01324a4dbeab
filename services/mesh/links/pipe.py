"""A connected stream socket: one thread reads and waits, whoever holds the mesh's lock writes and never
waits.

The rules come from what RFCOMM sockets do (docs/frames.md, faults): the end of a connection may be an empty
read or any error, a second read after it may block for ever, and closing the descriptor under a blocked
reader is unsafe. So every fault only shuts the socket down, which wakes the reader, and the reader alone
closes it.
"""

import contextlib
import socket

READ_SIZE = 65536


class Pipe:
    """One connection over a stream socket. Subclasses may wrap what is written and delay what is read."""

    def __init__(self, sock: socket.socket) -> None:
        self._sock = sock
        self._rest = b""
        self._shut = False
        self.fault = ""
        """Why a write failed; the reader, woken by it, reports it."""

    def fileno(self) -> int:
        """For select."""
        return self._sock.fileno()

    # -- the reader's side -------------------------------------------------------------------------

    def read(self) -> bytes:
        """Wait for bytes; b"" or an OSError is the end, after which it must not be called again."""
        return self._sock.recv(READ_SIZE)

    def close(self) -> None:
        """Close the descriptor. By the reader, when it will read no more and nobody can write."""
        self._shut = True
        self._sock.close()

    # -- the writers' side, under the mesh's lock --------------------------------------------------

    def offer(self, data: bytes) -> None:
        """Take bytes to be written; only when `flush` said that nothing is left."""
        self._rest = data

    def flush(self) -> bool:
        """Write what goes without waiting; True when nothing is left, or the connection has ended."""
        while self._rest and not self._shut:
            try:
                count = self._sock.send(self._rest, socket.MSG_DONTWAIT | socket.MSG_NOSIGNAL)
            except (BlockingIOError, InterruptedError):
                return False
            except OSError as error:
                self.fault = describe(error)
                self.shutdown()
                break
            self._rest = self._rest[count:]
        return True

    def shutdown(self) -> None:
        """End the connection and wake the reader. Harmless when repeated."""
        if not self._shut:
            self._shut = True
            with contextlib.suppress(OSError):
                self._sock.shutdown(socket.SHUT_RDWR)


def describe(error: OSError) -> str:
    """A short reason for a lost transport."""
    return (error.strerror or str(error) or type(error).__name__).lower()
