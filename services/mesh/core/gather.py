"""Neighbours' values of one iteration go to the own bus together: a robot in lockstep can use none of them alone.

Waking up is most of what a message costs the bus and the app's host: five neighbours' values by themselves cost them
three times as much as together. So x(k) of one neighbour waits here for the others' x(k), at most `HOLD`, and the last
one to come never waits. Who is waited for is learned from what comes: a neighbour that lets the others wait in vain is
not waited for again until it is heard. All else (questions, answers, repeated or strange frames) goes on at once, with
what waits before it: then the order of things may matter.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field

from services.mesh.core.events import Received
from swarm.core.lockstep_actions import address_of
from swarm.core.lockstep_frames import STEP, Channel, head
from swarm.errors import FrameError

HOLD = 0.02
"""s that a value may wait: more than neighbours' values are apart on links with jitter, and much less than a host waits
before it asks for what it lacks (`swarm.core.lockstep.WANT_AFTER`)."""

MAX_HELD = 64
"""Values that one lockstep may have waiting, whatever neighbours send."""

MAX_KEYS = 256
"""Keys whose lockstep is remembered; past that, all are found anew."""

_NEVER = float("inf")


@dataclass(slots=True)
class Round:
    """One lockstep of one app, as this robot's neighbours tell of it."""

    heard: dict[str, int] = field(default_factory=dict)
    """The newest iteration of each neighbour that is waited for."""
    floor: int = -1
    """The smallest of them when values went on last."""
    held: list[Received] = field(default_factory=list)
    until: float = _NEVER
    """When the oldest of those that wait goes on at the latest."""

    def release(self) -> list[Received]:
        """What waits goes on now."""
        held, self.held, self.until = self.held, [], _NEVER
        self.floor = min(self.heard.values(), default=-1)
        return held


class Gather:
    """All locksteps of one robot. Calls with `now` must not go back in time."""

    __slots__ = ("_by_key", "_rounds")

    def __init__(self) -> None:
        self._rounds: dict[tuple[str, int, int, int], Round] = {}
        self._by_key: dict[str, tuple[Round, bool] | None] = {}

    def add(self, peer: str, message: Received, now: float) -> list[Received]:
        """A message of the class sync from a neighbour; gives what goes to the bus now."""
        key = message.key
        found = self._by_key[key] if key in self._by_key else self._find(key)
        if found is None:
            return [message]
        it, to_all = found
        kind, k = head(message.payload)
        known = it.heard.get(peer)
        if not to_all or kind != STEP or known is None or k <= known:
            if to_all and kind == STEP:
                it.heard[peer] = k
            held = it.release()
            held.append(message)
            return held
        it.heard[peer] = k
        it.held.append(message)
        if min(it.heard.values()) > it.floor or len(it.held) >= MAX_HELD:
            return it.release()
        if it.until == _NEVER:
            it.until = now + HOLD
        return []

    def lost(self, peer: str) -> list[Received]:
        """There is no link with a neighbour any more; gives what waited for it."""
        released = []
        for it in self._rounds.values():
            if it.heard.pop(peer, None) is not None:
                released += it.release()
        return released

    def handle_timer(self, now: float) -> list[Received]:
        """What has waited long enough."""
        released = []
        for it in self._rounds.values():
            if now >= it.until:
                it.heard = {peer: k for peer, k in it.heard.items() if k > it.floor}
                released += it.release()
        return released

    def next_deadline(self) -> float:
        """When `handle_timer` wants to be called."""
        deadline = _NEVER
        for it in self._rounds.values():
            if it.until < deadline:
                deadline = it.until
        return deadline

    def _find(self, key: str) -> tuple[Round, bool] | None:
        """The lockstep of a key, and whether all neighbours get what comes under it; None: no key of a lockstep over
        its own links."""
        if len(self._by_key) >= MAX_KEYS:
            self._by_key.clear()
            # What waits stays where its timer finds it; the others are of no use any more.
            self._rounds = {of: it for of, it in self._rounds.items() if it.held}
        found = None
        address = address_of(key)
        if address is not None and not address.around:
            try:
                channel = Channel.parse(address.channel)
            except FrameError:
                pass  # what robots say about the members, or nothing of ours
            else:
                of = address.app, channel.run, channel.epoch, channel.schema
                found = self._rounds.setdefault(of, Round()), address.to is None
        self._by_key[key] = found
        return found


def by_app(messages: Iterable[Received]) -> dict[str, list[tuple[str, bytes]]]:
    """What hosts of apps hear of some messages: key and payload of each frame of a lockstep, by app, in order."""
    found: dict[str, list[tuple[str, bytes]]] = {}
    for message in messages:
        if (address := address_of(message.key)) is not None:
            found.setdefault(address.app, []).append((message.key, message.payload))
    return found
