"""`swarm/stop` in the whole swarm, and taking it back: a register that neighbours merge, not a message that passes.

Every stop has a mark (incarnation and count of the robot it was given on). A re-arm names the marks that it takes
back: those its robot knew. Each robot keeps the greatest mark of each robot's stops, and of each robot's re-arms; the
swarm is stopped while there is a stop above its re-arm. Merging takes the greater marks, so it makes no difference
in which order, how late or how often news arrive: a late copy of a stop is not above its re-arm, and a re-arm takes
no stop back that it did not know of.

What is new to a robot it sends to its other neighbours at once, ahead of everything that waits for their links. All
that it knows it sends to a neighbour whose link came up, and to all neighbours 1 s after news and then every 10 s.

`Register` is that register, `Stops` tells this robot's bus, and the swarm, which robots have stopped the swarm.
"""

import struct
import zlib
from collections.abc import Callable
from typing import NamedTuple

from services.mesh.core.actions import Emit, Transmit
from services.mesh.core.overlays.flood import FloodOverlay
from services.mesh.core.wire.frames import BULK, CONTROL, FLOOD, HALTS
from services.mesh.core.wire.packets import HALT, MAX_INCARNATION, MAX_SEQUENCE, PacketReader, packed
from swarm.errors import FrameError
from swarm.messages import Stop, Stopped
from swarm.messages.codec import encode
from swarm.messages.keys import STOP
from swarm.messages.keys import key as key_of
from swarm.messages.service import MAX_REASON, short_reason

_HALT = struct.Struct("<BBB")

_MARK = struct.Struct("<QI")
_LENGTH = struct.Struct("<H")
_CHECKSUM = struct.Struct("<I")

_HALT_ENTRIES = 20
"""Robots in one HALT packet: at most 1.9 kB."""


class Mark(NamedTuple):
    """A stop of one robot. Later ones are greater."""

    incarnation: int
    number: int


class Halt(NamedTuple):
    """All that a robot knows of stops and of what re-armed the swarm."""

    stops: dict[str, tuple[Mark, str]]
    """The newest stop of each robot, and its reason."""
    arms: dict[str, Mark]
    """The newest stop of each robot that was taken back."""


def encode_halts(halt: Halt) -> list[bytes]:
    """Return HALT packets: each may be understood without the others."""
    stops = [
        packed(name) + _MARK.pack(*mark) + packed(reason, MAX_REASON)
        for name, (mark, reason) in sorted(halt.stops.items())
    ]
    arms = [packed(name) + _MARK.pack(*mark) for name, mark in sorted(halt.arms.items())]
    packets = []
    # Stops first: should the rest be lost, the swarm rests.
    for part in _parts(stops):
        packets.append(_HALT.pack(HALT, len(part), 0) + b"".join(part))
    for part in _parts(arms):
        packets.append(_HALT.pack(HALT, 0, len(part)) + b"".join(part))
    return packets


def _parts(entries: list[bytes]) -> list[list[bytes]]:
    return [entries[at : at + _HALT_ENTRIES] for at in range(0, len(entries), _HALT_ENTRIES)]


def decode_halt(data: bytes) -> Halt:
    """Decode a HALT packet. Each stop that can be read counts, whatever follows it: another release may append to
    it. A re-arm counts only in a packet that is understood to its end."""
    reader = PacketReader(data)
    _, stops, arms = reader.unpack(_HALT)
    halt = Halt({}, {})
    try:
        for _ in range(stops):
            name, mark = reader.name(), Mark(*reader.unpack(_MARK))
            halt.stops[name] = (mark, reader.octets()[:MAX_REASON].decode(errors="ignore"))
        for _ in range(arms):
            name = reader.name()
            halt.arms[name] = Mark(*reader.unpack(_MARK))
        reader.end()
    except FrameError:
        if not halt.stops:
            raise
        halt.arms.clear()
    return halt


def to_file(halt: Halt) -> bytes:
    """Return HALT packets as a file: a checksum, then each packet behind its length."""
    packets = b"".join(_LENGTH.pack(len(packet)) + packet for packet in encode_halts(halt))
    return _CHECKSUM.pack(zlib.crc32(packets)) + packets


def from_file(data: bytes) -> Halt:
    """Return what `to_file` was given; raises `FrameError` where a byte of the file has changed."""
    if data[: _CHECKSUM.size] != _CHECKSUM.pack(zlib.crc32(data[_CHECKSUM.size :])):
        raise FrameError("its checksum is wrong")
    halt, at = Halt({}, {}), _CHECKSUM.size
    while at < len(data):
        size = int.from_bytes(data[at : at + _LENGTH.size], "little")
        at += _LENGTH.size + size
        if at > len(data):
            raise FrameError("a HALT packet that is cut off")
        part = decode_halt(data[at - size : at])
        halt.stops.update(part.stops)
        halt.arms.update(part.arms)
    return halt


_NONE = Mark(0, 0)
"""The mark of no stop."""


def without_greatest(halt: Halt, robot: str, first: Mark) -> Halt:
    """Return kept stops without the robots in whose name there is a mark of the greatest incarnation. Nothing is above
    it, so such a robot gives no more stops while anybody knows that mark. If its stop holds, it becomes a stop of
    `robot`, with the mark `first` of this start."""
    marks = [*halt.arms.items(), *((name, mark) for name, (mark, _) in halt.stops.items())]
    lies = {name for name, mark in marks if mark.incarnation == MAX_INCARNATION}
    stops = {name: stop for name, stop in halt.stops.items() if name not in lies}
    for name, (mark, reason) in halt.stops.items():
        if name in lies and mark > halt.arms.get(name, _NONE):
            stops[robot] = (first, reason)
    return Halt(stops, {name: mark for name, mark in halt.arms.items() if name not in lies})


REPEAT_PERIOD = 10.0
"""Seconds between two messages to each neighbour once there was a stop."""

FIRST_REPEAT = 1.0
"""Seconds from news to its first repetition: a link whose queue is full may have dropped it."""

MAX_STRANGERS = 64
"""Robots that are not in the configuration of which stops are kept: a member may make up as many as it likes."""

SPACING = 0.1
"""Mean seconds between two stops of this robot: who publishes `swarm/stop` in a loop must not fill the links."""

AT_ONCE = 5
"""Stops of this robot that leave without waiting for `SPACING` after a time without any. People and apps that stop the
swarm again within 0.1 s give fewer."""

_NEVER = float("inf")


class Register:
    """The stops that this robot knows. Calls with `now` must not go back in time."""

    def __init__(
        self,
        me: str,
        incarnation: Callable[[], int],
        robots: frozenset[str],
        *,
        emit: Emit,
        changed: Callable[[], None],
    ) -> None:
        """`changed()` is called whenever a stop or a re-arm is new."""
        self._me = me
        self._incarnation = incarnation
        self._robots = robots
        self._emit = emit
        self._changed = changed
        self._stops: dict[str, tuple[Mark, str]] = {}
        self._arms: dict[str, Mark] = {}
        self._known_since: dict[str, float] = {}
        """The time, s, at which this robot heard of each robot's newest stop."""
        self._links: dict[str, None] = {}
        self._repeat_at = _NEVER
        self._given_again_at = self._next_stop_at = -_NEVER
        self._waiting: str | None = None
        self._channel = key_of(me, "mesh", "halt")

    @property
    def stops(self) -> dict[str, str]:
        """The robots whose stop holds, with its reason; empty = the swarm is armed."""
        return {
            name: reason for name, (mark, reason) in sorted(self._stops.items()) if mark > self._arms.get(name, _NONE)
        }

    def restore(self, halt: Halt, now: float) -> None:
        """Take what an earlier process of this robot knew."""
        self._merge(self._admitted(halt), None, now)

    def to_file(self) -> bytes:
        """Return all that this robot knows, for `from_file`."""
        return to_file(Halt(self._stops, self._arms))

    def stop(self, reason: str, now: float) -> None:
        """Somebody on this robot stops the swarm."""
        if now < self._next_stop_at:
            self._waiting = reason
            return
        self._waiting = None
        self._next_stop_at = max(self._next_stop_at, now - (AT_ONCE - 1) * SPACING) + SPACING
        mark = self._next_mark()
        if mark.incarnation <= MAX_INCARNATION:
            self._merge(Halt({self._me: (mark, short_reason(reason))}, {}), None, now)
        # Else somebody has taken back the greatest mark there is in our name
        # (docs/reference/network/captured-member.md).

    def arm(self, now: float, age: float = 0.0) -> None:
        """Somebody on this robot takes back every stop that it knew of `age` seconds ago: a command is repeated until
        it is confirmed, and must not take back a stop that was given meanwhile."""
        if age <= 0.0:
            self._waiting = None
        by = now - max(age, 0.0)
        known = {name: mark for name, (mark, _) in self._stops.items() if self._known_since[name] <= by}
        self._merge(Halt({}, known), None, now)

    def receive(self, peer: str, data: bytes, now: float) -> None:
        """Take news of a neighbour; raises `FrameError`. Its list of robots may be another than ours: stops of robots
        that are not in our configuration hold as well, and are passed on."""
        halt = decode_halt(data)
        admitted = self._admitted(halt)
        self._merge(admitted, peer, now)
        if admitted != halt:
            raise FrameError(f"HALT with more than {MAX_STRANGERS} robots that are not in our configuration")

    def link_up(self, peer: str) -> None:
        """Send all stops to a neighbour that is there."""
        self._links[peer] = None
        self._send(peer, Halt(self._stops, self._arms))

    def link_down(self, peer: str) -> None:
        """Remove a neighbour that is gone."""
        self._links.pop(peer, None)

    def handle_timer(self, now: float) -> None:
        """Do everything that is due at `now`."""
        if self._waiting is not None and now >= self._next_stop_at:
            self.stop(self._waiting, now)
        if now >= self._repeat_at:
            self._repeat_at = now + REPEAT_PERIOD
            for peer in self._links:
                self._send(peer, Halt(self._stops, self._arms))

    def next_deadline(self) -> float:
        """Return the time at which `handle_timer` must be called."""
        return self._repeat_at if self._waiting is None else min(self._repeat_at, self._next_stop_at)

    def _admitted(self, halt: Halt) -> Halt:
        """Return what is said of robots of our configuration, and of as many others as there is room for. A stop that
        holds takes the place of those that were taken back."""
        strangers = (self._stops.keys() | self._arms.keys()) - self._robots
        for name, (mark, _) in halt.stops.items():
            if name in self._robots or name in strangers or mark <= halt.arms.get(name, _NONE):
                continue
            if len(strangers) >= MAX_STRANGERS:
                for old in strangers - self.stops.keys():
                    strangers.remove(old)
                    for known in (self._stops, self._arms, self._known_since):
                        known.pop(old, None)
            if len(strangers) < MAX_STRANGERS:
                strangers.add(name)
        for name in (*halt.stops, *halt.arms):
            if name not in self._robots and len(strangers) < MAX_STRANGERS:
                strangers.add(name)
        names = self._robots | strangers
        return Halt(
            {name: stop for name, stop in halt.stops.items() if name in names},
            {name: mark for name, mark in halt.arms.items() if name in names},
        )

    def _merge(self, halt: Halt, source: str | None, now: float) -> None:
        news = Halt({}, {})
        own = self._stops[self._me] if source is not None and self._me in self.stops else None
        for name, (mark, reason) in halt.stops.items():
            if mark > self._stops.get(name, (_NONE, ""))[0]:
                self._stops[name] = news.stops[name] = (mark, reason)
                self._known_since[name] = now
        for name, mark in halt.arms.items():
            if mark > self._arms.get(name, _NONE):
                self._arms[name] = news.arms[name] = mark
        if own is not None and self._greatest_mark() > own[0] and self._may_give_again(now):
            # A neighbour knows a greater mark in our name than that of our stop: of before a start, when our clock was
            # ahead. It says nothing about this stop, which therefore gets a mark above it.
            self._stops[self._me] = news.stops[self._me] = (self._next_mark(), own[1])
            self._given_again_at = now
            source = None
        if news.stops or news.arms:
            self._repeat_at = min(self._repeat_at, now + FIRST_REPEAT)
            for peer in self._links:
                if peer != source:
                    self._send(peer, news)
            self._changed()

    def _may_give_again(self, now: float) -> bool:
        """Return whether this robot's stop may have a new mark: at once where it holds no more, else once in a while.
        Two robots with one name would outdo each other without end."""
        due = self._me not in self.stops or now >= self._given_again_at + FIRST_REPEAT
        return due and self._next_mark().incarnation <= MAX_INCARNATION

    def _greatest_mark(self) -> Mark:
        """Return the greatest mark in this robot's name, of a stop or of a re-arm."""
        return max(self._stops.get(self._me, (_NONE, ""))[0], self._arms.get(self._me, _NONE))

    def _next_mark(self) -> Mark:
        """Return the mark of a new stop of this robot, above all that it knows."""
        return max(Mark(self._incarnation(), 1), _above(self._greatest_mark()))

    def _send(self, peer: str, halt: Halt) -> None:
        # In packets of their own: an earlier release takes no re-arm from a packet with a name that it does not know.
        for known in (True, False):
            stops = {name: stop for name, stop in halt.stops.items() if (name in self._robots) is known}
            arms = {name: mark for name, mark in halt.arms.items() if (name in self._robots) is known}
            for data in encode_halts(Halt(stops, arms)):
                self._emit(Transmit(peer, FLOOD, self._channel, data, HALTS))


def _above(mark: Mark) -> Mark:
    """Return the next mark."""
    if mark.number < MAX_SEQUENCE:
        return Mark(mark.incarnation, mark.number + 1)
    return Mark(mark.incarnation + 1, 1)


STOP_PERIOD = 1.0
"""Seconds between two repetitions of `swarm/stop` on the own bus while the swarm is stopped: a service that starts,
or a message that was lost, must not make an exception."""

CONFIRM_AFTER = 0.05
"""Seconds from a change of the register until `mesh/stopped` is flooded: stops that are given on many robots at once
make one flood of each robot."""

MAX_NAMED = 16
"""Robots that `mesh/stopped` names: with their reasons it stays far below what a flood carries."""


class Stops:
    """Watches the register."""

    def __init__(
        self, me: str, register: Register, flood: FloodOverlay, to_bus: Callable[[str, bytes, int], None]
    ) -> None:
        """`to_bus(key, payload, class)` publishes on the own bus."""
        self._me = me
        self._register = register
        self._flood = flood
        self._to_bus = to_bus
        self._key = key_of(me, "mesh", "stopped")
        self._confirmed: dict[str, str] = {}
        self._tell_at = _NEVER
        self._confirm_at = _NEVER

    def changed(self, now: float) -> None:
        """The register has changed."""
        self._to_bus(self._key, encode(self.stopped(now)), CONTROL)
        self._tell(now)
        self._confirm_at = min(self._confirm_at, now + CONFIRM_AFTER)

    def handle_timer(self, now: float) -> None:
        """Do everything that is due at `now`."""
        if now >= self._tell_at:
            self._tell(now)
        if now >= self._confirm_at:
            self._confirm_at = _NEVER
            if self._confirmed != (stops := self._register.stops):
                self._confirmed = stops
                # To all robots, and not in the control class, where the stops themselves are.
                self._flood.publish(self._key, encode(self.stopped(now)), BULK, now, latest=True)

    def next_deadline(self) -> float:
        """Return the time at which `handle_timer` must be called."""
        return min(self._tell_at, self._confirm_at)

    def stopped(self, now: float) -> Stopped:
        """Return the message for the key `mesh/stopped`."""
        stops = sorted(self._register.stops.items(), key=lambda stop: stop[0] != self._me)
        return Stopped(now, bool(stops), dict(stops[:MAX_NAMED]))

    def _tell(self, now: float) -> None:
        stops = self._register.stops
        self._tell_at = now + STOP_PERIOD if stops else _NEVER
        for origin, reason in stops.items():
            self._to_bus(STOP, encode(Stop(now, origin, reason, repeated=True)), CONTROL)
