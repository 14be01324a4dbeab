"""The mesh of one robot: its links, what it relays over them, and what it tells about them.

A node owns one `Link` for each neighbour and any number of sessions, of which at most one is a link's own.
The shell moves bytes between sessions and transports, carries out `actions()`, and calls `handle_timer` at
`next_deadline()`.
"""

from collections import Counter
from collections.abc import Callable
from functools import partial

from services.mesh.core.actions import (
    Action,
    Close,
    Connect,
    Dial,
    Disconnect,
    LinkAction,
    LinksChanged,
    LogLine,
    Transmit,
    Write,
)
from services.mesh.core.events import Event, HandshakeFailed, LinkDown, LinkRecovered, LinkSuspect, LinkUp, Received
from services.mesh.core.link import neighbour
from services.mesh.core.link.calls import REFUSED, UNKNOWN, Caller, Callers, Local
from services.mesh.core.link.clock import ClockState, ClockSync
from services.mesh.core.link.neighbour import Holds, Link
from services.mesh.core.link.outbox import name_of
from services.mesh.core.link.session import DOWN, SENT, SUSPECT, Session
from services.mesh.core.overlays import flood, robot_overlays, unicast
from services.mesh.core.overlays.robot_overlays import RobotOverlays
from services.mesh.core.relay import KeyRelay, RelaySend
from services.mesh.core.wire import frames
from swarm.errors import FrameError
from swarm.messages import Echo, EchoRequest, HoldLink, LinkState

COUNTERS = (*REFUSED.values(), *SENT, *robot_overlays.COUNTERS, "byes", "half_open", "inbound_refused", "incomplete",
            "no_link", "overflowed", "pushed_back", "replaced", "too_large", "transport_lost")  # fmt: skip
"""What the mesh of a robot counts; docs/frames.md and docs/overlays.md say what."""

MAX_NOTED = 256
"""Different problems logged; later new ones are only counted."""


def longest(overlay: int, priority: int) -> int:
    """The longest payload of a relayed value, bytes."""
    if overlay == frames.NEIGHBOURS:
        return frames.MAX_MESSAGE if priority == frames.BULK else frames.MAX_PAYLOAD
    return flood.limit_of(priority) if overlay == frames.FLOOD else unicast.limit_of(priority)


class MeshNode:
    """The mesh of one robot. Calls with `now` must not go back in time; no call may overlap another."""

    def __init__(
        self,
        local: Local,
        relay: KeyRelay,
        overlays: RobotOverlays,
        *,
        random: Callable[[], float],
        nonce: Callable[[], bytes],
        counters: Counter[str],
    ) -> None:
        """`random` gives uniform numbers from 0 up to 1, `nonce` 16 bytes nobody can foresee. Which links there are
        is said by `overlays.linking`."""
        assert overlays.linking is not None
        self._local = local
        self._random = random
        self._relay = relay
        self.overlays = overlays
        self._nonce = nonce
        self._counters = counters
        counters.update(dict.fromkeys(COUNTERS, 0))
        self._links: dict[str, Link] = {}
        self._holds = Holds()
        self._prober = neighbour.Prober(local.robot, local.dials)
        self._clock = ClockSync(local.robot, local.incarnation, local.robots)
        self._session = partial(
            Session, local,
            admit=self._admit, clock=self._clock, counters=counters, has_room=overlays.linking.has_room,
            is_held=self._holds.holds, clash=self._clash,
        )  # fmt: skip
        self._sessions: list[Session] = []
        self._callers = Callers()
        self._half_open: dict[Session, Caller] = {}
        self._ready: list[Session] = []
        self._actions: list[Action] = []
        self._noted: set[str] = set()
        self._deadline = 0.0
        """When something is due, as of the last time that it may have become earlier."""
        self._serve_overlays()

    # -- inputs ------------------------------------------------------------------------------------

    def accepted(self, now: float, caller: Caller = UNKNOWN) -> Session | None:
        """Somebody connected; None = no handshake with this one, close it."""
        if (refusal := self._callers.refusal(caller, self._half_open.values(), now)) is not None:
            counter, problem, text = refusal
            self._counters[counter] += 1
            self._note(problem, text)
            return None
        session = self._open(None, now, caller.robot)
        self._half_open[session] = caller
        return session

    def dialled(self, peer: str, now: float) -> Session:
        """The connection to `peer` that we asked for is there."""
        return self._open(peer, now)

    def dial_failed(self, peer: str, reason: str, now: float) -> None:
        """The connection that we asked for could not be made."""
        if (link := self._links.get(peer)) is not None:
            link.failed(reason, now)
            self._actions.append(LinksChanged())
        self.overlays.dial_failed(peer, reason, now)
        self._serve_overlays()

    def receive(self, session: Session, data: bytes, now: float) -> None:
        """Bytes arrived on a session's transport."""
        session.receive(data, now)
        self._digest(session, now)

    def transport_down(self, session: Session, reason: str, now: float) -> None:
        """A session's transport has ended; ignored where the session had ended before."""
        if session.state != DOWN:
            self._counters["transport_lost"] += 1
            session.transport_down(reason)
            self._digest(session, now)

    def publish(self, source: int | None, key: str, payload: bytes, now: float) -> None:
        """A sample of the own bus; `source` is the index of the subscription that delivered it, None for what came
        another way."""
        for send in self._relay.publish(source, key, payload, now):
            self._send(send, now)
        if (held := self._relay.next_deadline()) is not None and held < self._deadline:
            self._deadline = held

    def ask(self, step: Callable[[RobotOverlays, float], object], now: float) -> None:
        """Something for the overlays to do: a request of an app, a stop."""
        step(self.overlays, now)
        self._serve_overlays()

    def ping(self, request: EchoRequest, now: float) -> None:
        """Measure a link; the answers come out of `actions` as messages for the own bus."""
        link = self._links.get(request.peer)
        if (refusal := self._prober.ping(request, link, now)) is not None:
            self._actions.append(self._prober.told(refusal))
        if link is not None and link.session is not None:
            self._ready.append(link.session)

    def hold(self, request: HoldLink, now: float) -> None:
        """Have no link with a neighbour for a while, or let it come back."""
        if request.peer not in self._local.dials:
            self._note(f"hold {request.peer}", f"no link to hold: {request.peer[:80]!r}")
            return
        held = self._holds.take(request, now)
        self._tell(f"link {'held down' if held else 'let up'} peer={request.peer} seconds={request.seconds:g}")
        for session in tuple(self._sessions):
            if held and session.peer == request.peer:
                session.close(frames.HELD, frames.BYE_TEXT[frames.HELD])
                self._digest(session, now)

    def handle_timer(self, now: float) -> None:
        """Whatever is due. Call it at `next_deadline` or any other time."""
        for session in tuple(self._sessions):
            session.handle_timer(now)
            self._digest(session, now)
        for link in tuple(self._links.values()):
            if link.session is None and link.dialler is not None and link.dialler.take(now):
                link.attempt = True
                self._actions += (Dial(link.peer), LinksChanged())
        for send in self._relay.handle_timer(now):
            self._send(send, now)
        self._look_for_clashes(now)
        for peer, link in self._links.items():
            if link.session is not None and (rtt := link.session.pulse.rtt) is not None:
                self.overlays.measured(peer, rtt, now)
        self.overlays.handle_timer(now)
        self._serve_overlays()

    def leave(self, now: float) -> None:
        """Tell the swarm that this robot's mesh stops; send what that gives, then `close`."""
        self.overlays.leave(now)
        self._serve_overlays()

    def close(self, now: float) -> None:
        """End all connections: this robot's mesh stops."""
        for session in tuple(self._sessions):
            session.close(frames.CLOSING, "stopping")
            self._digest(session, now)

    # -- outputs -----------------------------------------------------------------------------------

    def actions(self) -> list[Action]:
        """What is to be done, in this order, since the last call."""
        actions, self._actions = self._actions, []
        return actions

    def ready(self) -> list[Session]:
        """Sessions that have had something to send since the last call."""
        ready, self._ready = self._ready, []
        return ready

    def next_deadline(self) -> float:
        """When `handle_timer` wants to be called. It may turn out to be early, never late."""
        return self._deadline

    def links(self) -> tuple[LinkState, ...]:
        """All links as they are, sorted by peer."""
        links = [link for _, link in sorted(self._links.items()) if link.lasting or link.session is not None]
        return tuple([link.state() for link in links])

    def clashes(self, now: float) -> dict[str, str]:
        """Names that two robots have, and how that was noticed."""
        return self.overlays.clashes.named(now)

    def clock(self, now: float) -> ClockState:
        """The mesh clock."""
        return self._clock.state(now)

    # -- inside ------------------------------------------------------------------------------------

    def _open(self, peer: str | None, now: float, expected: str | None = None) -> Session:
        session = self._session(self._nonce(), now, dialled=peer, expected=expected)
        self._sessions.append(session)
        self._ready.append(session)
        self._deadline = self._earliest()
        return session

    def _earliest(self) -> float:
        """When something is due."""
        # After each packet of an overlay, so without lists, generators and calls for each link.
        earliest = self.overlays.next_deadline()
        if (deadline := self._relay.next_deadline()) is not None and deadline < earliest:
            earliest = deadline
        for session in self._sessions:
            if session.deadline < earliest:
                earliest = session.deadline
        for link in self._links.values():
            if (
                link.session is None
                and link.dialler is not None
                and (deadline := link.dialler.next_deadline()) is not None
            ):
                earliest = min(earliest, deadline)
        return earliest

    def _send(self, send: RelaySend, now: float) -> None:
        leg, payload = send
        if len(payload) > (largest := longest(leg.overlay, leg.priority)):
            self._counters["too_large"] += 1
            self._note(leg.key, f"{leg.key}: {len(payload)} bytes, the mesh carries at most {largest} in its class")
            return
        if leg.overlay != frames.NEIGHBOURS:
            if leg.overlay == frames.FLOOD:
                self.overlays.flood(leg.key, payload, leg.priority, now, latest=leg.latest)
            else:
                for peer in leg.peers:
                    self.overlays.send(
                        peer, leg.key, payload, leg.priority, now, latest=leg.latest, avoid_link=leg.avoid_link
                    )
            self._serve_overlays()
            return
        for peer in leg.peers:
            if (link := self._links.get(peer)) is None:
                continue
            if (session := link.session) is None:
                self._counters["no_link"] += 1
                link.dropped += 1
                continue
            session.send(leg.priority, leg.key, payload, latest=leg.latest)
            self._ready.append(session)

    def _serve_overlays(self) -> None:
        """Carry out what the overlays want, and look for the next deadline: whatever links, their sessions or diallers
        do that may make it earlier, the overlays are told of."""
        for action in self.overlays.actions():
            if isinstance(action, Transmit):
                link = self._links.get(action.peer)
                session = link.session if link is not None else None
                if session is not None and session.is_up:
                    name = name_of(action.overlay, action.key)
                    if not session.send(action.priority, name, action.payload, latest=action.latest):
                        self.overlays.pushed_back(action)
                    self._ready.append(session)
            elif isinstance(action, Received):
                self._actions.append(action)
            else:
                self._on_topology(action)
        self._deadline = self._earliest()

    def _on_topology(self, action: LinkAction) -> None:
        """What the topology wants of this robot's links."""
        match action:
            case Connect(peer, once):
                link = self._links.setdefault(peer, Link(peer))
                if once:
                    link.attempt = True
                    self._actions.append(Dial(peer))
                    return
                link.keep(self._random if self._local.dials.get(peer) else None)
                self._links_changed()
            case Disconnect(peer, code):
                self._drop_link(peer, code)
            case Write():
                self._actions.append(action)
            case LogLine(text, True):
                self._note(text, text)
            case LogLine(text):
                self._tell(text)

    def _drop_link(self, peer: str, code: int) -> None:
        """Have no link with a robot any more."""
        if (link := self._links.get(peer)) is not None and link.session is not None:
            self._end(link, link.session, code, frames.BYE_TEXT[code], self.overlays.now)
        if self._links.pop(peer, None) is not None:
            self._links_changed()

    def _links_changed(self) -> None:
        self._relay.set_peers(link.peer for link in self._links.values() if link.lasting or link.session is not None)
        self._actions.append(LinksChanged())

    def _admit(self, peer: str, overlay: int, key: str) -> bool:
        if overlay == frames.NEIGHBOURS:
            admitted = self._relay.admits(peer, key) or self._prober.sender(key) == peer
        else:
            admitted = self.overlays.admits(peer, overlay, key)
        if admitted:
            return True
        self._note(f"key from {peer}", f"key refused peer={peer} key={key[:80]!r}: no relay rule lets it in")
        return False

    def _digest(self, session: Session, now: float) -> None:
        """Turn a session's events into actions and into states of links."""
        for event in session.events():
            if type(event) is Received:
                assert session.peer is not None
                if event.overlay != frames.NEIGHBOURS:
                    self.overlays.receive(session.peer, event.overlay, event.key, event.payload, event.priority, now)
                    self._serve_overlays()
                elif self._prober.sender(event.key) is not None:
                    self._on_probe(session, event, now)
                else:
                    self._actions.append(event)
            else:
                self._on_event(session, event, now)
        if session.state == DOWN:
            self._remove(session)
        elif session.wants_to_send:
            self._ready.append(session)

    def _on_probe(self, session: Session, event: Received, now: float) -> None:
        """A ping that is to be answered, or an answer. One that is no such thing is dropped."""
        try:
            result = self._prober.receive(event.key, event.payload, now)
        except FrameError as error:
            self._counters["inbound_refused"] += 1
            self._note(f"echo from {session.peer}", f"echo refused peer={session.peer} reason={error}")
            return
        if isinstance(result, Echo):
            self._actions.append(self._prober.told(result))
        elif result is not None and session.is_up:
            session.send(event.priority, neighbour.pong_key(self._local.robot), result, latest=False)

    def _on_event(self, session: Session, event: Event, now: float) -> None:
        peer = session.peer
        match event:
            case LinkUp(name):
                if (caller := self._half_open.pop(session, None)) is not None:
                    self._callers.confirmed(caller)
                if clash := self._clash(name, session.process, now):
                    # Another one has made its link while this one's handshake was under way.
                    self._on_failed(session, clash, frames.CLASH, None, now)
                    session.close(frames.CLASH, clash)
                    session.events()
                    return
                if (old := self._links.get(name)) is not None and old.session is not None:
                    # It was started anew, perhaps: no need to wait for silence.
                    self._end(old, old.session, frames.REPLACED, "replaced by a newer connection", now)
                link = self._links.setdefault(name, Link(name))
                link.session = session
                link.since = now
                link.attempt = False
                link.connection += 1
                if link.dialler is not None:
                    link.dialler.up(now)
                if self.overlays.link_up(name, now):
                    self._tell(f"link up peer={name} connection={link.connection}")
                    self._links_changed()
                else:
                    self._drop_link(name, frames.UNWANTED)
                self._serve_overlays()
            case LinkSuspect():
                self._tell(f"link suspect peer={peer}")
            case LinkRecovered():
                self._tell(f"link heard again peer={peer}")
            case LinkDown(reason, code, said):
                assert peer is not None
                self._hear(peer, said, now)
                if code in (frames.BAD_FRAME, frames.BAD_TAG):
                    self._note(f"{peer} {code}", f"connection ended peer={peer} reason={reason}")
                if (down := self._links.get(peer)) is not None and down.session is session:
                    self._detach(down, session, reason, now)
                    self._tell(f"link down peer={peer} reason={reason}")
            case HandshakeFailed(reason, code, said):
                self._on_failed(session, reason, code, said, now)

    def _clash(self, robot: str, process: int, now: float) -> str:
        """Why a robot's process may have no link because another robot has its name; empty where it may."""
        link, clashes = self._links.get(robot), self.overlays.clashes
        if not process:
            return ""  # a caller that tells no process is taken for the robot that it names
        if link is not None and (session := link.session) is not None and session.process not in (0, process):
            if session.state == SUSPECT:
                return ""  # it was started anew, perhaps: no need to wait for silence
            text = f"{self._local.robot} has a link with one of them"
        elif (other := clashes.elsewhere(robot, process)) is not None:
            text = f"{other} has a link with one of them"
        else:
            return ""
        clashes.seen(robot, process, text, now)
        return f"another robot is called {robot}, too: {text}"

    def _look_for_clashes(self, now: float) -> None:
        """End young links with the second robot of a name."""
        clashes = self.overlays.clashes
        for peer, link in tuple(self._links.items()):
            session = link.session
            if session is not None and (reason := clashes.check_link(peer, session.process, link.since, now)):
                self._end(link, session, frames.CLASH, reason, now)
                self._tell(f"link down peer={peer} reason={reason}")
        self._name_clashes(now)

    def _name_clashes(self, now: float) -> None:
        """Say in the log and in the link state which names two robots have."""
        self.overlays.tell_clashes(now)
        for robot, text in self.overlays.clashes.named(now).items():
            self._note(f"clash {robot}", text)

    def _hear(self, peer: str, said: int | None, now: float) -> None:
        """What the other end of a connection says at its end."""
        if said == frames.CLASH:
            text = f"{peer} refuses a link with this one"
            self.overlays.clashes.seen(self._local.robot, self._local.process, text, now)

    def _on_failed(self, session: Session, reason: str, code: int | None, said: int | None, now: float) -> None:
        caller, address = session.dialled or "a caller", ""
        if (known := self._half_open.pop(session, None)) is not None:
            caller, address = known.robot or caller, f" address={known.source}" if known.source else ""
            if code is not None:
                self._callers.refused(known, now)
        if code is not None:
            if session.peer in self._links:
                self._links[session.peer].refused += 1
            # One line for all strangers: who calls from many addresses must not fill the log. A clash of names has its
            # own, once it is sure.
            if code != frames.CLASH:
                self._note(f"{caller} {code}", f"connection refused peer={caller}{address} reason={reason}")
        elif session.peer is not None and said in REFUSED:
            # Who calls may have told its name and then why it wants no link after all.
            self._hear(session.peer, said, now)
            if (link := self._links.get(session.peer)) is not None and link.session is None:
                link.reason = reason
            if said != frames.CLASH:
                self._note(f"{caller} says {said}", f"connection refused by peer={session.peer} reason={reason}")
        if frames.CLASH in (code, said):
            self._name_clashes(now)
        if session.dialled is not None:
            self.dial_failed(session.dialled, reason, now)

    def _end(self, link: Link, session: Session, code: int, reason: str, now: float) -> None:
        """Close the connection of a link from our side."""
        self._detach(link, session, reason, now)
        session.close(code, reason)
        session.events()
        self._remove(session)

    def _detach(self, link: Link, session: Session, reason: str, now: float) -> None:
        self._clock.lost(link.peer)
        self.overlays.clashes.link_down(link.peer)
        link.detach(session, reason, now)
        self.overlays.link_down(link.peer, now)
        self._serve_overlays()

    def _remove(self, session: Session) -> None:
        if session in self._sessions:
            self._sessions.remove(session)
            self._actions.append(Close(session))

    def _tell(self, text: str) -> None:
        self._actions += (LinksChanged(), LogLine(text, problem=False))

    def _note(self, problem: str, text: str) -> None:
        """Log a problem the first time only: neighbours may repeat it as often as they like."""
        if problem not in self._noted and len(self._noted) < MAX_NOTED:
            self._noted.add(problem)
            self._actions.append(LogLine(text, problem=True))
