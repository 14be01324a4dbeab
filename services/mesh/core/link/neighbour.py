"""A neighbour as a node keeps it: the connection in use, the counters of all connections so far, holds and echoes.

**Holds** are links that are cut on purpose, as an operator wishes. One end suffices: it ends the connection, and
refuses every new one with a reason that the other end tells. A link is held for a limited time and not through a
restart, so that a robot that nobody reaches any more has its links again.

**Echoes** measure a link by payload size (`swarm measure`). A ping is an ordinary message of the `neighbours` overlay
under a key that never reaches a bus: the other mesh sends it back, whole or only its head, in the same class. So what
is measured is what messages of that size meet: queue, window, fragments, air.
"""

import math
import struct
from collections.abc import Callable, Iterable, Mapping
from typing import NamedTuple

from services.mesh.core.link import Received
from services.mesh.core.link.calls import Dialler
from services.mesh.core.link.session import CONNECTING, DOWN, Session
from services.mesh.core.wire.frames import BULK, MAX_MESSAGE, MAX_PAYLOAD, SYNC
from swarm.core.percentile import percentile
from swarm.errors import FrameError
from swarm.messages import Echo, EchoRequest, HoldLink, LinkState
from swarm.messages.codec import encode
from swarm.messages.keys import key

MAX_SECONDS = 600.0


class Holds:
    """The links of one robot that are held for a while."""

    def __init__(self) -> None:
        self._until: dict[str, float] = {}

    def take(self, request: HoldLink, now: float) -> bool:
        """Begin, prolong or end (0 s) the hold of a neighbour; whether there is one now."""
        if not 0.0 < request.seconds < math.inf:
            self._until.pop(request.peer, None)
            return False
        self._until[request.peer] = now + min(request.seconds, MAX_SECONDS)
        return True

    def holds(self, peer: str, now: float) -> bool:
        """Return whether there may be no link with a robot."""
        return now < self._until.get(peer, -math.inf)


class Link:
    """One robot that this one has a link with, or is to have."""

    def __init__(self, peer: str) -> None:
        self.peer = peer
        self.dialler: Dialler | None = None
        """None where the neighbour dials us, or is only called once."""
        self.lasting = False
        """Whether the link is to be there; else it is one as long as it is up."""
        self.session: Session | None = None
        """The connection in use, once it is up."""
        self.since = 0.0
        """The time at which that connection came up."""
        self.unanswered = 0
        """Handshakes in a row that took too long: the next one gets twice the time, since the link may be slow."""
        self.attempt = False
        """Whether our dialling, or the handshake after it, is under way."""
        self.connection = 0
        self.reason = "not connected yet"
        self.sent = 0
        """Frames of earlier connections."""
        self.received = 0
        self.sent_bytes = 0
        self.received_bytes = 0
        self.dropped = 0
        """Messages lost while the link was down, or in the queues of earlier connections."""
        self.refused = 0

    def keep(self, random: Callable[[], float] | None) -> None:
        """The link is to last; `random` where we are the one who dials."""
        self.lasting = True
        if random is None:
            self.dialler = None
        if self.dialler is None and random is not None:
            self.dialler = Dialler(random)
            if self.attempt or self.session is not None:
                self.dialler.take(0.0)  # its first call is under way already

    def failed(self, reason: str, now: float, page: float = 0.0) -> None:
        """Note that an attempt to connect failed; `page` as in `Dialler.ended`."""
        self.attempt = False
        self.reason = reason
        if self.dialler is not None:
            self.dialler.ended(now, page)

    def attach(self, session: Session, now: float) -> None:
        """A connection is up: it is the one in use from now on."""
        self.session = session
        self.since = now
        self.unanswered = 0
        self.attempt = False
        self.connection += 1
        if self.dialler is not None:
            self.dialler.up(now)

    def detach(self, session: Session, reason: str, now: float) -> None:
        """The connection in use is lost, or is given up."""
        self.session = None
        self.reason = reason
        self.sent += session.sent
        self.received += session.received
        self.sent_bytes += session.sent_bytes
        self.received_bytes += session.received_bytes
        self.dropped += session.queue.dropped
        if self.dialler is not None:
            self.dialler.ended(now)

    def state(self) -> LinkState:
        """Return the state for the key `mesh/links`."""
        session = self.session
        if session is None:
            state = CONNECTING if self.attempt else DOWN
            return LinkState(
                self.peer,
                state,
                self.connection,
                None,
                self.sent,
                self.received,
                self.reason,
                sent_bytes=self.sent_bytes,
                received_bytes=self.received_bytes,
                dropped=self.dropped,
                refused=self.refused,
            )
        pulse, window = session.pulse, session.window
        rtts = sorted(pulse.rtts)
        return LinkState(
            self.peer,
            session.state,
            self.connection,
            pulse.rtt,
            self.sent + session.sent,
            self.received + session.received,
            "",
            rtt_min=rtts[0] if rtts else None,
            rtt_median=rtts[len(rtts) // 2] if rtts else None,
            rtt_p99=percentile(rtts, 99) if rtts else None,
            sent_rate=pulse.sent_rate,
            received_rate=pulse.received_rate,
            sent_bytes=self.sent_bytes + session.sent_bytes,
            received_bytes=self.received_bytes + session.received_bytes,
            queue=session.queue.waiting_bytes,
            in_flight=window.in_flight,
            window=int(window.limit),
            dropped=self.dropped + session.queue.dropped,
            refused=self.refused,
        )


CLASSES: Mapping[str, tuple[int, int]] = {"sync": (SYNC, MAX_PAYLOAD), "bulk": (BULK, MAX_MESSAGE)}
"""Class and largest size by the name in a request."""

MAX_COUNT = 256
"""Pings of one request."""

FORGET = 30.0
"""Seconds after which an answer is no longer waited for."""

MAX_AWAITED = 4096
"""Answers that are waited for at most; then the oldest is given up."""

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
        self.sender: Callable[[str], str | None] = {**self._pongs, **self._pings}.get
        """The neighbour whose pings or answers travel under a key; None where neither do. Asked of each message."""
        self._sent: dict[tuple[str, int, int], _Sent] = {}

    def ping(self, request: EchoRequest, link: Link | None, now: float) -> Echo | None:
        """Send what a request asks for; the echo that says why that cannot be."""
        reason = fault(request)
        session = link.session if link is not None else None
        if link is None:
            reason = f"{request.peer} is not a neighbour"
        elif session is None:
            reason = f"the link to {request.peer} is down"
        elif not reason:
            self._forget(now)
            for index, ping in enumerate(_pings_of(request)):
                if not session.queue.push(CLASSES[request.priority][0], self._key, ping, latest=False):
                    reason = f"the queue of the link to {request.peer} is full"
                    break
                self._await(request, index, now)
        return Echo(now, request.peer, request.sequence, 0, request.size, None, reason) if reason else None

    def told(self, echo: Echo) -> Received:
        """Return an echo as a message for the own bus."""
        return Received(self._echo_key, encode(echo), SYNC)

    def _await(self, request: EchoRequest, index: int, now: float) -> None:
        name = request.peer, request.sequence, index
        self._sent.pop(name, None)  # so that the newest stand last
        self._sent[name] = _Sent(now, request.size)
        if len(self._sent) > MAX_AWAITED:
            del self._sent[next(iter(self._sent))]

    def _forget(self, now: float) -> None:
        while self._sent and now >= self._sent[oldest := next(iter(self._sent))].at + FORGET:
            del self._sent[oldest]

    def receive(self, key: str, payload: bytes, now: float) -> bytes | Echo | None:
        """Take a neighbour's ping or answer. Return the answer to send, or the echo of our own ping; None where
        nobody waits for it any more. Raises `FrameError`."""
        if key in self._pings:
            return _answer(payload)
        peer = self._pongs[key]
        sequence, index, _ = _head(payload)
        sent = self._sent.pop((peer, sequence, index), None)
        return None if sent is None else Echo(now, peer, sequence, index, sent.size, now - sent.at, "")


def fault(request: EchoRequest) -> str:
    """Explain what is wrong with a request; empty where nothing is."""
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


def _pings_of(request: EchoRequest) -> list[bytes]:
    flags = _SHORT if request.short else 0
    padding = bytes(request.size - MIN_SIZE)
    return [_HEAD.pack(request.sequence, index, flags) + padding for index in range(request.count)]


def _answer(payload: bytes) -> bytes:
    """Return the answer to a ping."""
    _, _, flags = _head(payload)
    return payload[:MIN_SIZE] if flags & _SHORT else payload


def _head(payload: bytes) -> tuple[int, int, int]:
    if len(payload) < MIN_SIZE:
        raise FrameError(f"an echo of {len(payload)} bytes: it has at least {MIN_SIZE}")
    sequence, index, flags = _HEAD.unpack_from(payload)
    return sequence, index, flags
