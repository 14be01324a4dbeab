"""The mesh of one robot: its links, what it relays over them, and what it tells about them.

A node joins the robot's bus (`KeyRelay`), the overlays (`RobotOverlays`) and the connections (`Connections`). The
shell moves bytes between sessions and transports, tells `connections` what comes in, carries out `actions`, and calls
`handle_timer` at `next_deadline()`.
"""

from collections import Counter
from collections.abc import Callable, Iterable

from services.mesh.core.actions import (
    Actions,
    Connect,
    Disconnect,
    LogLine,
    Neighbours,
    Transmit,
    Write,
    WriteStops,
)
from services.mesh.core.connections import Connections
from services.mesh.core.link import Received
from services.mesh.core.link.calls import REFUSED, UNKNOWN, Caller, Local
from services.mesh.core.link.outbox import SENT
from services.mesh.core.link.session import Session
from services.mesh.core.overlays import carried, robot_overlays
from services.mesh.core.relay import KeyRelay, RelaySend
from services.mesh.core.wire import frames, packets

COUNTERS = (*REFUSED.values(), *SENT, *robot_overlays.COUNTERS, "byes", "half_open", "inbound_refused", "incomplete",
            "no_link", "overflowed", "pushed_back", "replaced", "too_large", "transport_lost")  # fmt: skip
"""What the mesh of a robot counts; docs/reference/network/frames.md and docs/reference/network/overlay-packets.md say
what."""


class MeshNode:
    """The mesh of one robot. Calls with `now` must not go back in time; no call may overlap another."""

    def __init__(
        self,
        local: Local,
        relay: KeyRelay,
        overlays: robot_overlays.RobotOverlays,
        *,
        random: Callable[[], float],
        nonce: Callable[[], bytes],
        counters: Counter[str],
    ) -> None:
        """`random` gives uniform numbers from 0 up to 1, `nonce` 16 bytes nobody can foresee. Which links there are
        is said by `overlays.linking`."""
        assert overlays.linking is not None
        self._robots = local.robots
        self._relay = relay
        self.overlays = overlays
        self._carried = overlays.linking.carried
        """Whether neighbours are reached over links of others, too: then the topology says who they are."""
        self._counters = counters
        counters.update(dict.fromkeys(COUNTERS, 0))
        self.actions = Actions()
        self.connections = Connections(
            local,
            overlays,
            self.actions,
            admit=self._admit,
            serve=self._serve_overlays,
            set_peers=self._set_linked,
            random=random,
            nonce=nonce,
            counters=counters,
        )
        self._deadline = 0.0
        """The time at which something is due, as of the last time that it may have become earlier."""
        self._serve_overlays()

    # -- inputs ------------------------------------------------------------------------------------

    def accepted(self, now: float, caller: Caller = UNKNOWN) -> Session | None:
        """Somebody connected; None = no handshake with this one, close it."""
        session = self.connections.accepted(caller, now)
        self._deadline = self._earliest()
        return session

    def dialled(self, peer: str, now: float) -> Session:
        """The connection to `peer` that we asked for is there."""
        session = self.connections.open(peer, now)
        self._deadline = self._earliest()
        return session

    def publish(self, source: int | None, key: str, payload: bytes, now: float) -> None:
        """Send a sample of the own bus; `source` is the index of the subscription that delivered it, None for
        another way."""
        for send in self._relay.publish(source, key, payload, now):
            self._send(send, now)
        if (held := self._relay.next_deadline()) is not None and held < self._deadline:
            self._deadline = held

    def ask(self, step: Callable[[robot_overlays.RobotOverlays, float], object], now: float) -> None:
        """Something for the overlays to do: a request of an app, a stop."""
        step(self.overlays, now)
        self._serve_overlays()

    def handle_timer(self, now: float) -> None:
        """Whatever is due. Call it at `next_deadline` or any other time."""
        self.connections.handle_timer(now)
        for send in self._relay.handle_timer(now):
            self._send(send, now)
        self.connections.look_at_links(now)
        self.overlays.handle_timer(now)
        self._serve_overlays()

    def leave(self, now: float) -> None:
        """Tell the swarm that this robot's mesh stops; send what that gives, then `close`."""
        self.overlays.leave(now)
        self._serve_overlays()

    # -- outputs -----------------------------------------------------------------------------------

    def next_deadline(self) -> float:
        """Return the time at which `handle_timer` must be called. It may turn out to be early, never late."""
        return self._deadline

    # -- inside ------------------------------------------------------------------------------------

    def _earliest(self) -> float:
        """Return the time at which something is due."""
        earliest = min(self.overlays.next_deadline(), self.connections.next_deadline())
        held = self._relay.next_deadline()
        return earliest if held is None else min(earliest, held)

    def _set_linked(self, peers: Iterable[str]) -> None:
        """Take the robots with which there are links."""
        if not self._carried:
            self._relay.set_peers(peers)

    def _longest(self, overlay: int, priority: int) -> int:
        """Return the longest payload of a relayed value, bytes."""
        if overlay == frames.NEIGHBOURS and self._carried:
            return carried.limit_of(priority, self._robots)
        if overlay == frames.NEIGHBOURS:
            return frames.largest(priority, frames.MAX_PAYLOAD)
        room = packets.room(all_know=False) if overlay == frames.FLOOD else packets.UNICAST_ROOM
        return frames.largest(priority, room)

    def _send(self, send: RelaySend, now: float) -> None:
        leg, payload = send
        if len(payload) > (largest := self._longest(leg.overlay, leg.priority)):
            self._counters["too_large"] += 1
            text = f"{leg.key}: {len(payload)} bytes, the mesh carries at most {largest} in its class"
            self.actions.log_once(leg.key, text)
            return
        if leg.overlay == frames.NEIGHBOURS and not self._carried:
            for peer in leg.peers:
                self.connections.send(peer, leg.priority, leg.key, payload, latest=leg.latest)
            return
        if leg.overlay == frames.NEIGHBOURS:
            self.overlays.carry(leg.key, payload, leg.priority, leg.peers, now, latest=leg.latest)
        elif leg.overlay == frames.FLOOD:
            self.overlays.flood(leg.key, payload, leg.priority, now, latest=leg.latest)
        else:
            for peer in leg.peers:
                self.overlays.send(
                    peer, leg.key, payload, leg.priority, now, latest=leg.latest, avoid_link=leg.avoid_link
                )
        self._serve_overlays()

    def _serve_overlays(self) -> None:
        """Carry out what the overlays want, and look for the next deadline: whatever links, their sessions or diallers
        do that may make it earlier, the overlays are told of."""
        for action in self.overlays.actions():
            match action:
                case Transmit():
                    if not self.connections.transmit(action):
                        self.overlays.pushed_back(action)
                case Connect(peer, once):
                    self.connections.connect(peer, once=once)
                case Disconnect(peer, code):
                    self.connections.disconnect(peer, code)
                case Neighbours(robots):
                    self._relay.set_peers(robots)
                case LogLine(text, True):
                    self.actions.log_once(text, text)
                case LogLine(text):
                    self.actions.log_link(text)
                case Received() | Write() | WriteStops():
                    self.actions.add(action)
        self._deadline = self._earliest()

    def _admit(self, peer: str, overlay: int, key: str) -> bool:
        if overlay == frames.NEIGHBOURS:
            admitted = self.connections.prober.sender(key) == peer
            admitted = admitted or (not self._carried and self._relay.admits(peer, key))
        else:
            admitted = self.overlays.admits(peer, overlay, key)
        if not admitted:
            text = f"key refused peer={peer} key={key[:80]!r}: no relay rule lets it in"
            self.actions.log_once(f"key from {peer}", text)
        return admitted
