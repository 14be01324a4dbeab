"""The bus of one robot: a Zenoh router on the Unix socket RUNTIME/bus.sock, and nothing on the network.

It listens before it joins its own bus as a service, so that systemd hears READY only when others can connect.
"""

import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from swarm.bus.zenoh_bus import ROUTER, Router
from swarm.errors import BusError
from swarm.process.locks import take_lock
from swarm.process.paths import BUS_SOCKET, bus_endpoint, runtime_dir
from swarm.process.service import Service, die_with_parent, run

UMASK = 0o007
"""Connecting takes write permission on the socket, which follows the umask: owner and group, nobody else."""


LOOK_PERIOD_S = 2.0

LOCK = "bus.lock"


def main() -> None:
    """Route until SIGTERM or SIGINT."""
    die_with_parent()
    os.umask(UMASK)
    directory: Path = runtime_dir()
    endpoint = bus_endpoint(directory)
    with claim(directory), Router(endpoint), Service("bus") as service:
        service.ready()
        service.log.info("routing endpoint=%s", endpoint)
        # The watchdog is fed by the router's own answers, so that one that no longer routes is replaced.
        while not service.stopping.wait(LOOK_PERIOD_S):
            service.bus.ask(ROUTER, lambda *_: service.watchdog(), timeout_s=LOOK_PERIOD_S)


@contextmanager
def claim(directory: Path) -> Iterator[None]:
    """Hold the directory's bus for the time of the context, so that one router runs for it, however many are started at
    the same moment. Raises `BusError` where that cannot be.

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


if __name__ == "__main__":
    run(main, "Run the bus of this robot: a Zenoh router that listens on a Unix socket, and not on the network.")
