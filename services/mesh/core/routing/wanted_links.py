"""The links that this robot wants: those of the topology in force, and for a while those that hold the swarm together.

The topology (`routing.topology`) is a register that neighbours merge: the greatest value holds. A robot sends it over
each new link, and a new value to all other neighbours at once. So it reaches every robot in reach, whether or not its
issuer is still there. (A flooded latest value would be void when its origin restarts.)

Make before break: a new value's links are asked for at once, and a link that it does not contain stays until the new
ones hold the swarm together (`routing.spare_links`).

Where other links than the topology's own carry it (`routing.physical_links`), those are the wanted ones, and the
neighbours are whom the node sends to. What a successor of a lost hub adds is unwanted, and goes as above once the hub
is back.

Any robot of the configuration may call: it may have missed the news, or look for the rest of its swarm. Its link counts
as an unwanted one. Who cannot be reached is looked for (`link.calls`) once the topology is not the configuration's own.
"""

from collections import Counter
from collections.abc import Callable
from typing import NamedTuple

from services.mesh.core.actions import Connect, Disconnect, LinkAction, LogLine, Neighbours, Transmit, Write
from services.mesh.core.link.calls import EAGER, Search
from services.mesh.core.routing.automatic_topology import SETTLE, AutomaticRule
from services.mesh.core.routing.hub_choice import HubChoice, in_reach
from services.mesh.core.routing.link_state import LinkStateMap
from services.mesh.core.routing.physical_links import Succession, follow
from services.mesh.core.routing.spare_links import SpareLinks
from services.mesh.core.routing.topology import (
    AUTO,
    MAX_LINKS,
    MAX_STEP,
    MAX_VERSION,
    Ground,
    Hub,
    TopologyVersion,
    ends,
)
from services.mesh.core.wire import frames
from swarm.core.graph import Edge
from swarm.errors import LocalError
from swarm.messages import MeasuredHub
from swarm.messages.keys import key as key_of

LOOK = 0.05
"""Seconds from a change of the map until it is looked at: news come in packs."""

REPEAT_PERIOD = 10.0
"""Seconds between two messages to neighbours that still have another value, for queues may drop anything."""

DOUBT = 10.0
"""Seconds that a link of the topology must have been down, and called in vain, until its other end counts as out of
reach."""

_NEVER = float("inf")


class InitialLinks(NamedTuple):
    """The links that a robot knows before it has any."""

    ground: Ground
    dials: dict[str, bool]
    """All robots that this one could be linked with, and whether it dials them. A change of the hub changes it in
    place."""
    saved: TopologyVersion | None = None
    """The value that was kept when it was running last."""
    pages: bool = False
    """Whether robots are called by pages, as in `link.calls.Local`."""


class Linking:
    """The links of one robot. Calls with `now` must not go back in time."""

    def __init__(
        self,
        me: str,
        start: InitialLinks,
        map: LinkStateMap,
        *,
        act: Callable[[Transmit | LinkAction], None],
        random: Callable[[], float],
        counters: Counter[str],
    ) -> None:
        """`random` gives numbers from 0 up to 1."""
        self._me = me
        self._ground = start.ground
        self._dials = start.dials
        self._map = map
        self._act = act
        self._counters = counters
        callers = len(start.ground.names) if start.ground.carried else 0
        self._search = Search(random, callers, 0 if start.pages else EAGER)
        self._links: dict[str, None] = {}
        self._spare = SpareLinks(me, start.ground, map)
        self._reach: dict[str, bool] = {}
        """Whether we hear each of the robots that we dial, as far as we have tried."""
        self._down: dict[str, float] = {}
        """Links of the topology that are down, and since when."""
        self._rule = AutomaticRule(me, start.ground, map)
        self.missing: dict[str, str] = {}
        """Robots out of reach that this one has called, and why in vain."""
        self._channel = key_of(me, "mesh", "topology")
        self._look_at = 0.0
        self._plan_at = _NEVER
        self._repeat_at = _NEVER
        self._check_at = _NEVER
        self.value = max(start.saved or start.ground.first, start.ground.first)
        self.wanted = ends(self._ground.physical(self.value), me)
        """Robots that this one is to have links with."""
        self.adopted: float | None = None
        """The time at which the value came into force here; None before the first timer."""
        order = start.ground.order(self.value)
        self._succession = Succession(order, me)
        self._choice = HubChoice(start.ground.place[me])
        if self.carried:
            follow(self._dials, order, me)
            act(Neighbours(self.neighbours))
        for peer in sorted(self.wanted):
            act(Connect(peer))

    # -- inputs ------------------------------------------------------------------------------------------------

    def set(self, shape: str, edges: tuple[Edge, ...], after: int | None, now: float) -> str:
        """Somebody on this robot wants another topology; what is wrong with that, empty where it is in force."""
        version = self.value.version
        if after is not None and after != version:
            return f"version {version} is in force, not {after}: look at it (swarm mesh topology show) and set again"
        if version == MAX_VERSION:
            return f"version {version} is the last one: take the file `topology` out of all robots' state directories"
        try:
            links = self.value.edges if shape == AUTO else self._ground.edges_of(shape, edges)
        except LocalError as error:
            return str(error)
        self._adopt(TopologyVersion(version + 1, 0, self._me, shape == AUTO, links, self.value.hub), None, now)
        return ""

    def has_room(self, peer: str) -> bool:
        """Return whether a robot of the configuration may have a link with this one."""
        if peer in self._links or len(self._links) < MAX_LINKS:
            return True
        # While one set topology gives way to another there may be links of both; a radio knows itself what it holds.
        return peer in self.wanted and not self.value.auto

    def link_up(self, peer: str, now: float) -> bool:
        """Take a new connection; False where only the knowledge of it is of use."""
        self._search.ended(peer, now)
        self.missing.pop(peer, None)
        self._down.pop(peer, None)
        if self._dials.get(peer):
            self._note_reach(peer, True, now)
        needless = peer not in self.wanted and peer in self._map.routes() and self._map.topology(peer) == self.tag
        if needless or not self.has_room(peer):
            return False
        self._links[peer] = None
        self._send(peer)
        self._look_soon(now)
        return True

    def link_down(self, peer: str, now: float) -> None:
        """Take the end of a connection."""
        if peer not in self._links:
            return
        del self._links[peer]
        self._spare.lost(peer)
        if peer in self.wanted:
            self._down[peer] = now
        else:
            self._act(Disconnect(peer, frames.UNWANTED))
        self._look_soon(now)

    def dial_failed(self, peer: str, reason: str, now: float) -> None:
        """Note that a robot could not be reached."""
        self._search.ended(peer, now)
        if peer in self._links:
            return  # a second call crossed the one that succeeded
        if peer not in self._map.routes():
            self.missing[peer] = reason
        if peer not in self.wanted:
            self._act(Disconnect(peer, frames.UNWANTED))
            self._note_reach(peer, False, now)
        elif now >= self._down.setdefault(peer, now) + DOUBT:
            self._note_reach(peer, False, now)

    def is_reachable(self, peer: str) -> bool:
        """Return whether there is a way to a robot."""
        return peer in self._map.routes()

    def knocked(self, peer: str, now: float) -> None:
        """Call a robot soon that has shown that it is there."""
        self._search.hurry(peer, now)

    def receive(self, peer: str, data: bytes, now: float) -> None:
        """Take a neighbour's value. Raises `FrameError`."""
        value = self._ground.decode(data)
        if value is None:
            self._counters["topology_foreign"] += 1
            self._act(LogLine(f"{peer} has another configuration: robots or topology differ", problem=True))
            if peer not in self.wanted:
                self._act(Disconnect(peer, frames.NOT_NEIGHBOUR))
        elif value > self.value:
            self._adopt(value, peer, now)
        elif value < self.value:
            self._send(peer)

    def map_changed(self, now: float) -> None:
        """The link state may be another one."""
        self._look_soon(now)

    def handle_timer(self, now: float) -> None:
        """Do everything that is due at `now`."""
        if self.adopted is None:
            self.adopted = now
            self._down = dict.fromkeys(self.wanted, now)
            if self._ground.measured:
                self._choice.begin(now)
            self._announce(now)
        if now >= min(self._look_at, self._check_at):
            self._look(now)
        if now >= self._plan_at:
            self._plan(now)
        if now >= self._choice.next_deadline():
            self._choose(now)
        if now >= self._repeat_at:
            self._repeat_at = _NEVER
            for peer in self._links:
                if self._map.topology(peer) != self.tag:
                    self._repeat_at = now + REPEAT_PERIOD
                    self._send(peer)
        if (stranger := self._search.take(now)) is not None:
            self._act(Connect(stranger, once=True))

    def next_deadline(self) -> float:
        """Return the time at which `handle_timer` must be called."""
        return min(
            self._look_at,
            self._check_at,
            self._plan_at,
            self._repeat_at,
            self._search.next_deadline(),
            self._choice.next_deadline(),
        )

    # -- outputs -----------------------------------------------------------------------------------------------

    @property
    def tag(self) -> int:
        """The value's short name in link states."""
        return self._ground.tag(self.value)

    @property
    def carried(self) -> bool:
        """Whether other links than the topology's own carry it."""
        return self._ground.carried

    @property
    def neighbours(self) -> frozenset[str]:
        """Return the neighbours of this robot in the topology."""
        return self.value.neighbours(self._me)

    @property
    def physical(self) -> tuple[Edge, ...]:
        """The links that carry the topology."""
        return self._ground.physical(self.value)

    def hub(self) -> MeasuredHub | None:
        """Return the hub for the key `mesh/topology`; None where it is not chosen by measurement."""
        return self._choice.told(self.value.hub, self._ground.names) if self._ground.measured else None

    @property
    def up(self) -> tuple[str, ...]:
        """Neighbours of the topology whose links are up, or whom other links lead to."""
        there = self._map.routes().keys() if self.carried else self._links.keys() & self.wanted
        return tuple(sorted(self.neighbours & there))

    @property
    def kept(self) -> tuple[str, ...]:
        """Links that are up and not in the topology."""
        return tuple(sorted(self._links.keys() - self.wanted))

    def to_file(self) -> bytes:
        """Return the bytes to keep through restarts."""
        return self._ground.to_file(self.value)

    # -- the value ---------------------------------------------------------------------------------------------

    def _adopt(self, value: TopologyVersion, source: str | None, now: float) -> None:
        before, hub, self.value = self.wanted, self.value.hub, value
        self.wanted = ends(self.physical, self._me)
        if self.carried:
            self._act(Neighbours(self.neighbours))
        self.adopted = now
        self._spare.forget()
        if value.hub != hub:
            self._change_hub(hub, now)
        for peer in sorted(self.wanted - before):
            self._down[peer] = now
            self._act(Connect(peer))
        for peer in sorted(before - self.wanted):
            self._down.pop(peer, None)
            if peer not in self._links:
                self._act(Disconnect(peer, frames.UNWANTED))
        self._act(Write())
        kind = "auto" if value.auto else "fixed"
        text = f"topology version={value.version}.{value.step} by={value.issuer} {kind} links={len(value.edges)}"
        self._act(LogLine(text, problem=False))
        for peer in self._links:
            if peer != source:
                self._send(peer)
        self._repeat_at = now + REPEAT_PERIOD
        self._announce(now)
        self._look_soon(now)

    def _change_hub(self, before: Hub, now: float) -> None:
        """Take another choice of the hub, or another kind of the same."""
        hub, names, place = self.value.hub, self._ground.names, self._ground.place
        self._choice.adopted(hub, [place[name] for name in self._map.routes()], now)
        text = f"hub {names[hub.place]}{' on trial' if hub.trial else ''}, before it {names[hub.before]}"
        self._act(LogLine(f"{text} with a mean round trip of {hub.round_trip} ms", problem=False))
        if hub.place == before.place:
            return
        order = self._ground.order(self.value)
        self._succession.reorder(order)
        for peer in sorted(follow(self._dials, order, self._me) & self.wanted):
            self._act(Connect(peer))  # it is up to the other end now to call

    def _send(self, peer: str) -> None:
        data = self._ground.encode(self.value)
        priority = frames.CONTROL if len(data) <= frames.MAX_PAYLOAD else frames.BULK
        self._act(Transmit(peer, frames.FLOOD, self._channel, data, priority))

    def _announce(self, now: float) -> None:
        """Tell the swarm which value holds here and, where the automatic rule wants to know, whom we hear."""
        known = self._reach.items() if self.value.auto else ()
        heard = sum(1 << self._ground.place[peer] for peer, reached in known if reached)
        self._map.tell(self.tag, heard, now)

    def _note_reach(self, peer: str, reached: bool, now: float) -> None:
        if self._reach.get(peer) != reached:
            self._reach[peer] = reached
            self._announce(now)
            self._look_soon(now)

    # -- looking at the map ------------------------------------------------------------------------------------

    def _look_soon(self, now: float) -> None:
        self._look_at = min(self._look_at, now + LOOK)

    def _look(self, now: float) -> None:
        self._look_at = self._check_at = _NEVER
        # Routes are only asked for where somebody needs them: in a large swarm they cost more than all else here.
        if self.missing:
            for peer in self.missing.keys() & self._map.routes().keys():
                del self.missing[peer]
        if kept := self.kept:
            assert self.adopted is not None
            to_come = self.wanted - self._links.keys()
            needless, self._check_at = self._spare.needless(kept, to_come, self.value, self.adopted, now)
            for peer in needless:
                self._act(Disconnect(peer, frames.UNWANTED))
        if not self.value.auto and not self.value.version and not self.carried:
            return
        reachable = self._map.routes()
        strangers = [
            name for name, dials in self._dials.items() if dials and name not in self._links and name not in self.wanted
        ]
        far = [name for name in strangers if name not in reachable]
        if self.carried:
            far = self._succession.due(far, reachable.keys(), now)
            self._check_at = min(self._check_at, self._succession.next_deadline())
        if len(self._links) >= MAX_LINKS:
            self.missing |= dict.fromkeys(far, f"not called, this robot has all its {MAX_LINKS} links")
            far = strangers = []
        near = []
        if self.value.auto:
            near = [name for name in strangers if name in reachable and not self._reach.get(name)]
            self._plan_at = min(self._plan_at, now + SETTLE)
        self._search.aim(far, near, now)

    # -- the hub -----------------------------------------------------------------------------------------------

    def _choose(self, now: float) -> None:
        """Measure the links of this robot, where it is the hub, and let another one be it where that may pay."""
        hub = self._choice.look(self.value.hub, in_reach(self._me, self._ground.place, self._map), now)
        if hub != self.value.hub and self.value.step < MAX_STEP:
            self._adopt(self.value._replace(step=self.value.step + 1, issuer=self._me, hub=hub), None, now)

    # -- the automatic rule ------------------------------------------------------------------------------------

    def _plan(self, now: float) -> None:
        """Mend the topology, where that falls to this robot."""
        assert self.adopted is not None
        agreed = self._spare.is_agreed(self.value, self.adopted, now)
        edges, self._plan_at = self._rule.mend(self.value, now, agreed=agreed)
        if edges == self.value.edges:
            return
        if self.value.step == MAX_STEP:
            text = f"topology step {MAX_STEP} is the last one of version {self.value.version}: set a topology anew"
            self._act(LogLine(text, problem=True))
        else:
            self._adopt(self.value._replace(step=self.value.step + 1, issuer=self._me, edges=edges), None, now)
