"""Echoes between two meshes, to measure a link by payload size (`swarm measure`).

A ping is an ordinary message of the `neighbours` overlay under a key that never reaches a bus: the other mesh sends it
back, whole or only its head, in the same class. So what is measured is what messages of that size meet: queue, window,
fragments, air.
"""

import struct
from collections.abc import Iterable, Mapping
from typing import NamedTuple

from services.mesh.core.events import Received
from services.mesh.core.link.neighbour import Link
from services.mesh.core.wire.fragments import MAX_MESSAGE
from services.mesh.core.wire.frames import BULK, MAX_PAYLOAD, SYNC
from swarm.errors import FrameError
from swarm.messages import Echo, EchoRequest
from swarm.messages.codec import encode
from swarm.messages.keys import key

CLASSES: Mapping[str, tuple[int, int]] = {"sync": (SYNC, MAX_PAYLOAD), "bulk": (BULK, MAX_MESSAGE)}
"""Class and largest size by the name in a request."""

MAX_COUNT = 256
"""Pings of one request."""

FORGET = 30.0
"""s after which an answer is no longer waited for."""

_HEAD = struct.Struct("<QHB")
_SHORT = 1

MIN_SIZE = _HEAD.size


def ping_key(robot: str) -> str:
    """Under which a robot's pings travel."""
    return key(robot, "mesh", "ping")


def pong_key(robot: str) -> str:
    """Under which a robot's answers travel."""
    return key(robot, "mesh", "pong")


class _Sent(NamedTuple):
    at: float
    size: int


class Prober:
    """The pings that one robot exchanges with its neighbours."""

    def __init__(self, me: str, peers: Iterable[str]) -> None:
        self._key = ping_key(me)
        self._echo_key = key(me, "mesh", "echo")
        self._pings = {ping_key(peer): peer for peer in peers}
        self._pongs = {pong_key(peer): peer for peer in self._pings.values()}
        self._sent: dict[tuple[str, int, int], _Sent] = {}

    def sender(self, key: str) -> str | None:
        """The neighbour whose pings or answers travel under a key; None where neither do."""
        return self._pings.get(key) or self._pongs.get(key)

    def ping(self, request: EchoRequest, link: Link | None, now: float) -> Echo | None:
        """Send what a request asks for; the echo that says why that cannot be."""
        reason = fault(request)
        session = link.session if link is not None else None
        if link is None:
            reason = f"{request.peer} is not a neighbour"
        elif session is None:
            reason = f"the link to {request.peer} is down"
        elif not reason:
            for ping in self._pings_of(request, now):
                if not session.send(CLASSES[request.priority][0], self._key, ping, latest=False):
                    reason = f"the queue of the link to {request.peer} is full"
        return Echo(now, request.peer, request.sequence, 0, request.size, None, reason) if reason else None

    def told(self, echo: Echo) -> Received:
        """An echo as a message for the own bus."""
        return Received(self._echo_key, encode(echo), SYNC)

    def _pings_of(self, request: EchoRequest, now: float) -> list[bytes]:
        for name in [name for name, sent in self._sent.items() if now >= sent.at + FORGET]:
            del self._sent[name]
        flags = _SHORT if request.short else 0
        padding = bytes(request.size - MIN_SIZE)
        for index in range(request.count):
            self._sent[request.peer, request.sequence, index] = _Sent(now, request.size)
        return [_HEAD.pack(request.sequence, index, flags) + padding for index in range(request.count)]

    def receive(self, key: str, payload: bytes, now: float) -> bytes | Echo | None:
        """What a neighbour's ping or answer leads to: an answer to send, or the echo of a ping of ours; None where
        nobody waits for it any more. Raises `FrameError`."""
        if key in self._pings:
            return _answer(payload)
        peer = self._pongs[key]
        sequence, index, _ = _head(payload)
        sent = self._sent.pop((peer, sequence, index), None)
        return None if sent is None else Echo(now, peer, sequence, index, sent.size, now - sent.at, "")


def fault(request: EchoRequest) -> str:
    """What is wrong with a request; empty where nothing is."""
    if request.priority not in CLASSES:
        return f"class {request.priority!r}: expected {' or '.join(CLASSES)}"
    largest = CLASSES[request.priority][1]
    if not MIN_SIZE <= request.size <= largest:
        return f"size {request.size}: {MIN_SIZE} to {largest} bytes are allowed in class {request.priority}"
    if not 1 <= request.count <= MAX_COUNT or request.count * request.size > MAX_MESSAGE:
        return f"count {request.count}: 1 to {MAX_COUNT}, together at most {MAX_MESSAGE} bytes"
    if not 0 <= request.sequence < 1 << 63:
        return f"sequence {request.sequence}: expected 0 to 2^63 - 1"
    return ""


def _answer(payload: bytes) -> bytes:
    """What goes back for a ping."""
    _, _, flags = _head(payload)
    return payload[:MIN_SIZE] if flags & _SHORT else payload


def _head(payload: bytes) -> tuple[int, int, int]:
    if len(payload) < MIN_SIZE:
        raise FrameError(f"an echo of {len(payload)} bytes: it has at least {MIN_SIZE}")
    sequence, index, flags = _HEAD.unpack_from(payload)
    return sequence, index, flags
