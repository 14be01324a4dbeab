"""Ports of this computer for servers that are started a moment later."""

import atexit
import contextlib
import random
import socket

_FIRST, _LAST = 20_000, 32_000
"""Below the ports that the kernel gives to outgoing connections: one of those might take it meanwhile."""

_held: list[socket.socket] = []
_random = random.Random()
"""Apart from the module's own generator, which tests seed: all would try the same ports."""


def free_port() -> int:
    """Return a port that nobody uses, and that no other process gets here as long as this one lives.

    Tests run side by side. The kernel's own way, port 0, gives a port again as soon as it was let go of: of two
    servers that were to listen on it one would end, and who calls it would meet the other.
    """
    while True:
        port = _random.randint(_FIRST, _LAST)
        claim = socket.socket(socket.AF_UNIX)
        with contextlib.suppress(OSError), socket.socket() as probe:
            claim.bind(f"\0balboa-swarm-port-{port}")  # an abstract name ends with whoever holds it
            probe.bind(("127.0.0.1", port))
            _held.append(claim)
            return port
        claim.close()


@atexit.register
def _let_go() -> None:
    while _held:
        _held.pop().close()
