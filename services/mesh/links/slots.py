"""`slots:` links: a Bluetooth radio that one process simulates for all robots (`sim.processes.radio`).

Sockets keep packets apart (SOCK_SEQPACKET). At `RADIO_SOCKET` in the run directory, that of the robots' runtime
directories, the process takes one request on each connection, a msgpack map: `RadioCall` is answered by `RadioAnswer`,
and where that has no reason the connection is the link from then on. `RadioSupervise` and `RadioCut` have no answer.

It connects to the address of a robot that is called. The socket that it connects from has an address that ends in the
caller's name. Once it connects without a name: as long as that connection is there, the robot can be called.
"""

import contextlib
import os
import socket
from functools import partial
from pathlib import Path
from typing import Any

from services.mesh.core.link.calls import UNKNOWN, Caller
from services.mesh.links.pipe import Pipe
from services.mesh.links.sim import bound, only_mesh
from services.mesh.links.stream import BACKLOG, StreamListener
from swarm.errors import PayloadError
from swarm.frozen import frozen
from swarm.messages.codec import decode, encode

RADIO_SOCKET = "radio.sock"

SEND_BUFFER = 8192
"""Bytes, which the kernel doubles: room for a write of 4 kB. The radio has the rest of what an RFCOMM socket holds."""

MAX_PACKET = 4096
"""Bytes of a request or an answer, and of a write."""


@frozen
class RadioCall:
    """A robot wants a link to another one."""

    caller: str
    called: str


@frozen
class RadioAnswer:
    """The end of a call."""

    reason: str
    """Why there is no link; empty where there is one."""


@frozen
class RadioSupervise:
    """A robot wants to be the central of a link, and the radio to give it up after somewhat less silence than this."""

    robot: str
    peer: str
    seconds: float


@frozen
class RadioCut:
    """An order that nothing passes between two robots for seconds, or as long as an earlier cut lasts; 0 ends it."""

    a: str
    b: str
    seconds: float


Request = RadioCall | RadioSupervise | RadioCut

ENDED = "the simulated radio has ended"


def ask(radio: Path, request: Request) -> socket.socket:
    """Send a request to the radio, and return the connection; raises OSError."""
    sock = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    try:
        sock.connect(os.fspath(radio))
        sock.send(encode(request))
    except BrokenPipeError:
        sock.close()
        raise ConnectionError(ENDED) from None
    except OSError:
        sock.close()
        raise
    return sock


def dial(path: Path, me: str, peer: str) -> Pipe:
    """Have the radio call the robot `peer` at this address. A call ends in some time. Raises OSError."""
    radio = path.parent.parent / RADIO_SOCKET
    sock = ask(radio, RadioCall(me, peer))
    try:
        answer = decode(RadioAnswer, sock.recv(MAX_PACKET), "the radio's answer")
    except (OSError, PayloadError):
        sock.close()
        raise ConnectionError(ENDED) from None
    if answer.reason:
        sock.close()
        raise ConnectionError(answer.reason)
    pipe = _pipe(sock)
    pipe.limit = partial(_supervise, radio, me, peer)
    return pipe


def _supervise(radio: Path, me: str, peer: str, seconds: float) -> None:
    with contextlib.suppress(OSError):  # a radio that has ended has no link to give up
        ask(radio, RadioSupervise(me, peer, seconds)).close()


def _pipe(sock: socket.socket, caller: Caller = UNKNOWN) -> Pipe:
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER)
    return Pipe(sock, caller)


class SlotsListener(StreamListener):
    """A listener for robots that call this one over the simulated radio."""

    def __init__(self, path: Path, directory: Path, me: str) -> None:
        """`path`: the address of the robot `me`; `directory`: its runtime directory."""
        self._me = me
        self._lock = only_mesh(directory)
        self._path = path
        sock = bound(path, socket.SOCK_SEQPACKET)
        sock.listen(BACKLOG)
        super().__init__(sock)
        self._radio: socket.socket | None = None

    def close(self) -> None:
        super().close()
        if self._radio is not None:
            self._radio.close()
        self._path.unlink(missing_ok=True)
        self._lock.close()

    def _adopt(self, sock: socket.socket, address: Any) -> Pipe:
        caller = caller_at(address)
        if not caller:
            if self._radio is not None:
                self._radio.close()
            self._radio = sock
            raise ConnectionError("the radio itself, which asks whether this robot is there")
        pipe = _pipe(sock, Caller(caller, robot=caller))
        pipe.limit = partial(_supervise, self._path.parent.parent / RADIO_SOCKET, self._me, caller)
        return pipe


def call_from(number: int, caller: str) -> bytes:
    """Return the address, without a file, from which the radio of this process connects for a caller."""
    return f"\0swarm-radio/{os.getpid()}/{number}/{caller}".encode()


def caller_at(address: Any) -> str:
    """Return the caller's name in such an address; empty: the radio itself."""
    return bytes(address).decode(errors="replace").rpartition("/")[2] if isinstance(address, bytes) else ""
