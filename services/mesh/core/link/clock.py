"""The mesh clock: one time for the whole swarm, from the stamps that heartbeats carry anyway.

Every robot keeps C = own monotonic clock + offset. The root is the robot with the smallest name in reach; its offset
runs free. Every other robot follows a neighbour nearer to the root: C = the neighbour's C + the measured offset of the
two monotonic clocks. It slews (at most `MAX_SLEW`), and steps only where it is off by more than `STEP`, and for a
while after that. So robots agree without anybody's idea of the true time. A robot that becomes the root goes on with
the time it has; one that was started anew first takes over the time of the others, even where it is to be their root.

After FTSP (Maroti et al. 2004: root by smallest id, its flooded sequence number here called epoch) and PulseSync
(Lenzen et al. 2009). Two-way samples cancel the delay, not its asymmetry: half the difference of the two directions'
mean delays stays as an error of each hop, and cannot be observed.
"""

import math
import struct
from dataclasses import dataclass, field
from typing import NamedTuple

from services.mesh.core.link.link_clock import STEP, UNKNOWN_SKEW, ClockFit, LinkClock
from services.mesh.core.link.round_trips import MAX_APART
from services.mesh.core.wire import frames
from swarm.errors import FrameError
from swarm.messages.keys import is_name

MAX_SLEW = 500e-6
"""Largest change of rate by which an offset is corrected; a second of mesh time is never off by more."""

STEPS_FOR = 10.0
"""Seconds after such a step in which it steps again rather than slews: it rested on the first sample of each link,
whose jitter of some ms a hop would take half a minute to slew away."""

SETTLE = 2.0
"""Seconds in which an error decays by e, as far as `MAX_SLEW` allows: with 60 ppm between clocks the lag is 0.12 ms
a hop."""

EPOCH_PERIOD = 0.4
"""Seconds between two epochs of the root, at least; a little less than the heartbeat's, which carries them."""

FRESH = 2.5
"""Seconds for which a neighbour counts as connected to the root after it told a new epoch."""

ROOT_LOST = 5.0
"""Seconds without a new epoch after which a root is given up, and the smallest name left takes over."""

IN_COMPANY = 16
"""Epochs from which a root is in company. A robot counts them only while it shares the time of neighbours, so that it
is in company 6.4 to 8 s after it met the first: also with the first sample some heartbeats late, within 10 s."""

LISTEN = 10.0
"""Seconds in which a robot that was started anew follows a settled root, rather than be root itself: the swarm's time
survives a restart of the smallest name."""

COMPANY = 60.0
"""Seconds after its first neighbour's claim after which a robot that has met no settled root is settled itself. Two
robots that were started together meet each other at once, the swarm perhaps by their second knock at 24 to 48 s."""

ALONE = 150.0
"""Seconds after its start after which a robot that has heard nobody is settled: neighbours that have taken it for
absent may call it once in 142 s, and knock after knock may go to robots that are off."""

MAX_HOPS = 255
_CLAIM = struct.Struct("<IIBBQdff")
_CHILD, _SETTLED = 1, 2
_MAX_ROOTS = 64
_MAX_RATE = 1e-3


class ClockClaim(NamedTuple):
    """The claim about its clock that a robot sends to a neighbour beside each heartbeat."""

    root: str
    incarnation: int
    """u32 of the root's process: a root started anew counts its epochs from the beginning."""
    epoch: int
    """u32, counted up by a root that has neighbours: who hears it has a way to the root that worked a moment ago, and
    knows whether the root is in company."""
    hop: int
    """Links between the sender and the root."""
    child: bool
    """Whether the sender follows the receiver, which must not follow it in turn."""
    settled: bool
    """Whether the root has the time of a settled one, or had long enough to meet one."""
    at: float
    """Sender's monotonic clock, s, for which the following hold."""
    offset: float
    """C - monotonic clock of the sender, s."""
    rate: float
    """Change of `offset`, s/s."""
    error: float
    """Estimated standard deviation of the sender's C from the root's, s."""


def encode_claim(claim: ClockClaim) -> bytes:
    """Encode a CLOCK frame."""
    flags = claim.child * _CHILD | claim.settled * _SETTLED
    body = _CLAIM.pack(
        claim.incarnation,
        claim.epoch,
        claim.hop,
        flags,
        int(claim.at * 1e6),
        claim.offset,
        claim.rate,
        claim.error,
    )
    return frames.encode(frames.CLOCK, frames.CONTROL, body + claim.root.encode())


def decode_claim(body: bytes) -> ClockClaim:
    """Decode the body of a CLOCK frame. Raises `FrameError`."""
    if len(body) <= _CLAIM.size:
        raise FrameError(f"CLOCK of {len(body)} bytes: it has more than {_CLAIM.size}")
    incarnation, epoch, hop, flags, at, offset, rate, error = _CLAIM.unpack_from(body)
    root = body[_CLAIM.size :].decode("ascii", "replace")
    if not is_name(root):
        raise FrameError(f"CLOCK root {root[:32]!r}: not a robot's name")
    if flags & ~(_CHILD | _SETTLED):
        raise FrameError(f"CLOCK flags {flags:#x}: bits 0 and 1 are known")
    # NaN fails every comparison, so it is refused, too.
    if not (abs(offset) <= MAX_APART and abs(rate) <= _MAX_RATE and 0.0 <= error <= MAX_APART):
        raise FrameError(f"CLOCK offset {offset}, rate {rate}, error {error}: out of bounds")
    return ClockClaim(
        root, incarnation, epoch, hop, bool(flags & _CHILD), bool(flags & _SETTLED), at * 1e-6, offset, rate, error
    )


class ClockState(NamedTuple):
    """The mesh clock of this robot: C(t) = t + offset + rate (t - at)."""

    at: float
    offset: float
    rate: float
    root: str
    hop: int
    error: float


@dataclass(eq=False)
class _Neighbour:
    """A neighbour's claims, and the relation of its clock to ours."""

    link: LinkClock = field(default_factory=LinkClock)
    claim: ClockClaim | None = None
    advanced: float = -math.inf
    """The time at which it last told a new epoch of the root that it claims."""
    sampled: bool = False
    """Whether its clock was compared since the link is up: its machine may have been started anew before."""


class _Root(NamedTuple):
    """What was heard of a root."""

    epoch: int
    """The newest epoch of the root."""
    at: float
    """The time at which that epoch was heard of, s."""
    settled: bool


class ClockSync:
    """The mesh clock of one robot. Calls with `now`, its monotonic clock, must not go back in time."""

    def __init__(self, robot: str, incarnation: int, robots: frozenset[str]) -> None:
        """`robots` are those that may be root."""
        self._robot = robot
        self._incarnation = incarnation & 0xFFFFFFFF
        self._robots = robots
        self._neighbours: dict[str, _Neighbour] = {}
        self._roots: dict[tuple[str, int], _Root] = {}
        """What was heard of each root and incarnation."""
        self._settles_at = math.inf
        """The time from which this robot is settled; `inf` before its start."""
        self._alone = True
        """Whether no neighbour's claim has come yet."""
        self._root = (robot, self._incarnation)
        self._followed = robot
        """The robot whose time this is: the root as soon as there is a way to it."""
        self._parent: str | None = None
        self._hop = 0
        self._epoch = 0
        self._settled = False
        self._own_epoch = 1
        self._own_epoch_at = -math.inf
        self._at = 0.0
        self._offset = 0.0
        self._steps_until = -math.inf
        self._rate = 0.0
        self._error = 0.0

    # -- inputs --

    def sample(self, peer: str, now: float, rtt: float, offset: float) -> None:
        """Take the sample of a heartbeat: round trip, and the peer's monotonic clock minus ours, s."""
        neighbour = self._neighbour(peer)
        neighbour.sampled = True
        neighbour.link.add(now, rtt, offset)

    def hear(self, peer: str, claim: ClockClaim, now: float) -> None:
        """Take a neighbour's claim."""
        if claim.root not in self._robots or claim.root == self._robot:
            # Who still follows our own earlier process will hear of this one.
            claim = claim._replace(root=peer, child=True)
        if self._alone:
            self._alone = False
            if now < self._settles_at:
                self._settles_at = now + COMPANY
        neighbour = self._neighbour(peer)
        before, neighbour.claim = neighbour.claim, claim
        if claim.epoch < IN_COMPANY:
            # New robots that meet are in company for as long as the first of them.
            self._own_epoch = max(self._own_epoch, claim.epoch)
        if claim.child:
            return
        root = (claim.root, claim.incarnation)
        if before is None or (before.root, before.incarnation) != root or claim.epoch > before.epoch:
            neighbour.advanced = now
        known = self._roots.get(root)
        if known is None or claim.epoch > known.epoch:
            self._roots[root] = _Root(claim.epoch, now, claim.settled)
            if len(self._roots) > _MAX_ROOTS:
                del self._roots[min(self._roots, key=lambda each: self._roots[each].at)]

    def lost(self, peer: str) -> None:
        """The link to a neighbour is down: what it said is void, how its clock runs is not."""
        if (neighbour := self._neighbours.get(peer)) is not None:
            neighbour.claim, neighbour.sampled = None, False

    # -- outputs --

    def claim(self, peer: str, now: float) -> ClockClaim:
        """Return the claim to send to a neighbour now."""
        self._update(now)
        return ClockClaim(
            *self._root,
            self._epoch,
            self._hop,
            # Who has heard of the root but has no way to it yet has nothing to offer to anybody.
            peer == self._parent or self._followed != self._root[0],
            self._settled,
            now,
            self._offset,
            self._rate,
            min(self._error, MAX_APART),
        )

    def state(self, now: float) -> ClockState:
        """Return the mesh clock now."""
        self._update(now)
        return ClockState(now, self._offset, self._rate, self._followed, self._hop, self._error)

    # -- inside --

    def _neighbour(self, peer: str) -> _Neighbour:
        found = self._neighbours.get(peer)
        if found is None:
            found = self._neighbours[peer] = _Neighbour()
        return found

    def _update(self, now: float) -> None:
        if self._settles_at == math.inf:
            self._settles_at = now + ALONE
        passed = now - self._at
        self._set_offset(self._offset + self._rate * passed)
        self._at = now
        self._root = self._choose_root(now)
        if self._root[0] == self._robot:
            self._parent, self._hop, self._rate, self._error = None, 0, 0.0, 0.0
            self._followed = self._robot
            self._count_epoch(now)
            self._epoch = self._own_epoch
            self._settled = now >= self._settles_at
            return
        root = self._roots[self._root]
        if not root.settled:
            # The root is settled first, lest all robots of a swarm that was started together become roots at once.
            self._settles_at = max(self._settles_at, now + LISTEN)
        self._parent = self._choose_parent(now)
        if self._parent is None:
            self._rate = 0.0
            if self._followed != self._robot:
                self._error += UNKNOWN_SKEW * passed
            return
        parent = self._neighbours[self._parent]
        assert parent.claim is not None
        assert parent.link.fit is not None
        if root.epoch >= IN_COMPANY:
            self._count_epoch(now)
        self._hop = parent.claim.hop + 1
        self._epoch = parent.claim.epoch
        self._settled = parent.claim.settled
        if self._settled:
            self._settles_at = min(self._settles_at, now + LISTEN)
        self._follow(parent.claim, parent.link.fit, now)
        self._followed = self._root[0]

    def _count_epoch(self, now: float) -> None:
        in_company = any(neighbour.claim is not None for neighbour in self._neighbours.values())
        if in_company and now >= self._own_epoch_at + EPOCH_PERIOD:
            self._own_epoch, self._own_epoch_at = self._own_epoch + 1, now

    def _follow(self, claim: ClockClaim, fit: ClockFit, now: float) -> None:
        between = fit.offset_at(now)
        target = between + claim.offset + claim.rate * (now + between - claim.at)
        error = target - self._offset
        if abs(error) > STEP:
            self._steps_until = now + STEPS_FOR
        if now < self._steps_until:
            self._set_offset(target)
            error = 0.0
        self._rate = max(-MAX_SLEW, min(MAX_SLEW, error / SETTLE))
        # What is still to be slewed is an error, too.
        self._error = math.hypot(claim.error, fit.error_at(now), error)

    def _set_offset(self, offset: float) -> None:
        """Take an offset as far as the limit. What a neighbour nearer to the root claims may lead further. The next
        robot would take such a claim of this robot for a bad frame and end its link, although this robot is innocent.
        """
        self._offset = max(-MAX_APART, min(offset, MAX_APART))

    def _choose_root(self, now: float) -> tuple[str, int]:
        """Return the smallest name heard of lately, or the own one; of two incarnations the last one heard. Those in
        company go before others, and then settled ones: a time that robots share is not given up for that of new ones.
        """
        candidates = [
            (each.epoch < IN_COMPANY, not each.settled, root[0], -each.at, root)
            for root, each in self._roots.items()
            if now < each.at + ROOT_LOST
        ]
        own = (self._robot, self._incarnation)
        candidates.append((self._own_epoch < IN_COMPANY, now < self._settles_at, self._robot, -now, own))
        return min(candidates)[-1]

    def _choose_parent(self, now: float) -> str | None:
        """Return the neighbour with the fewest hops to the root, the present one where several have."""
        best = None
        for peer, neighbour in self._neighbours.items():
            claim = neighbour.claim
            if claim is None or claim.child or (claim.root, claim.incarnation) != self._root:
                continue
            if now >= neighbour.advanced + FRESH or claim.hop >= MAX_HOPS or not neighbour.sampled:
                continue
            rank = (claim.hop, peer != self._parent, peer)
            if best is None or rank < best[0]:
                best = (rank, peer)
        return None if best is None else best[1]
