"""The claim that lets one router run for one runtime directory, however many are started at the same moment."""

import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from swarm.errors import BusError
from swarm.process.locks import take_lock
from swarm.process.paths import BUS_SOCKET

LOCK = "bus.lock"


@contextmanager
def claim(directory: Path) -> Iterator[None]:
    """Hold the directory's bus for the time of the context; raises `BusError` where that cannot be.

    The lock ends with the process however it ends. Its file stays: removing it would let two processes lock
    two files of the same name. The socket that a killed router left behind is removed.
    """
    path = directory / LOCK
    try:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o660)
    except OSError as error:
        raise BusError(f"the runtime directory {directory} cannot be used: {error.strerror}") from None
    try:
        try:
            take_lock(descriptor)
        except BlockingIOError:
            holder = os.read(descriptor, 32).decode(errors="replace").strip() or "unknown"
            raise BusError(f"{path}: another bus is running there (pid {holder}); end it first") from None
        os.ftruncate(descriptor, 0)
        os.pwrite(descriptor, f"{os.getpid()}\n".encode(), 0)
        _remove_stale(directory / BUS_SOCKET)
        yield
    finally:
        os.close(descriptor)


def _remove_stale(path: Path) -> None:
    """Remove a socket nobody listens on; refuse one on which a program that ignores our lock does."""
    if not path.exists():
        return
    if not path.is_socket():
        raise BusError(f"{path} is not a socket; remove it")
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        probe.settimeout(1.0)
        try:
            probe.connect(os.fspath(path))
        except ConnectionRefusedError:
            path.unlink(missing_ok=True)
            return
        except OSError as error:
            raise BusError(f"{path} cannot be used: {error.strerror or error}") from None
    raise BusError(f"{path}: another program listens on this socket; end it first")
