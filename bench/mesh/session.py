"""What authentication costs a link: bytes and CPU time of a frame and of a handshake, without any IO."""

import hmac
import os
import struct
import time
import timeit
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass

from bench.rows import Row
from services.mesh.core.link.calls import Local
from services.mesh.core.link.clock import ClockSync
from services.mesh.core.link.session import Session
from services.mesh.core.wire import frames
from services.mesh.core.wire.auth import Tagger

KEYS = {1: bytes(range(32))}
KEY = "swarm/{}/app/consensus/sync/00000000000000a1-0-3-9f3c21aa"
LOCKSTEP = struct.pack("<BI", 1, 7)
"""Kind and iteration, which a lockstep message carries before its values (docs/reference/network/lockstep.md)."""

HEADER_LIMIT = 24
"""Bytes before and behind the values of a lockstep message, authenticated."""

HANDSHAKE_BUDGET_S = 1e-3
"""Both ends of a connection; a robot that starts makes seven at most."""


@dataclass(frozen=True)
class Sizes:
    """How much the area measures."""

    calls: int = 5000
    handshakes: int = 200


FULL = Sizes()
SMOKE = Sizes(50, 5)


def rows(sizes: Sizes = FULL) -> Iterator[Row]:
    """Measure; yields rows as they are there."""
    yield Row("header of an authenticated lockstep message", _header(), "B", HEADER_LIMIT, 1.0)
    message = frames.encode_data(frames.SYNC, 3, LOCKSTEP + bytes(16))
    rival = hmac.new(bytes(32), digestmod="sha256")
    tagger = Tagger(bytes(32))

    def by_hmac() -> bytes:
        mac = rival.copy()
        mac.update(message)
        return mac.digest()[: frames.TAG_SIZE]

    tag = _best(lambda: tagger(message), sizes.calls)
    yield Row("tag of a lockstep frame, beside HMAC-SHA256", tag, "s", _best(by_hmac, sizes.calls), 1.0)
    plain, sealed = _hop({}, sizes.calls), _hop(KEYS, sizes.calls)
    yield Row("session hop, both ends, beside an insecure one", sealed, "s", plain, 2.5)
    yield Row("handshake, both ends", _best(lambda: _connect(KEYS), sizes.handshakes), "s", HANDSHAKE_BUDGET_S, 1.0)


def _best(call: Callable[[], object], number: int) -> float:
    """CPU time of one call, s, the best of several batches: what else the machine does is no property of ours."""
    return min(timeit.repeat(call, number=number, repeat=9, timer=time.process_time)) / number


def _session(robot: str, peer: str, dials: bool, keys: dict[int, bytes]) -> Session:
    local = Local(robot, "lab", 1, not keys, {peer: dials}, frozenset((robot, peer)), keys=keys)
    dialled = peer if dials else None
    clock = ClockSync(local.robot, local.incarnation, local.robots)
    return Session(local, os.urandom(16), 0.0, dialled=dialled, admit=lambda *_: True, clock=clock, counters=Counter())


def _connect(keys: dict[int, bytes]) -> tuple[Session, Session]:
    one, other = _session("r0", "r1", True, keys), _session("r1", "r0", False, keys)
    for _ in range(2):
        to_other, to_one = one.data_to_send(0.0, 4096), other.data_to_send(0.0, 4096)
        other.receive(to_other, 0.0)
        one.receive(to_one, 0.0)
    assert one.is_up
    assert other.is_up
    return one, other


def _header() -> int:
    one, _ = _connect(KEYS)
    size = 0
    for _ in range(2):  # the first one brings its BIND along
        one.queue.push(frames.SYNC, KEY.format("r0"), LOCKSTEP + bytes(16), latest=False)
        size = len(one.data_to_send(0.0, 4096)) - 16
    return size


def _hop(keys: dict[int, bytes], calls: int) -> float:
    """One message: queued, made into a frame, taken apart and handed over."""
    one, other = _connect(keys)
    key, payload = KEY.format("r0"), LOCKSTEP + bytes(16)

    def hop() -> None:
        one.queue.push(frames.SYNC, key, payload, latest=False)
        other.receive(one.data_to_send(0.0, 4096), 0.0)
        assert other.events()
        if answer := other.data_to_send(0.0, 4096):  # an acknowledgement now and then, or the window fills
            one.receive(answer, 0.0)

    return _best(hop, calls)
