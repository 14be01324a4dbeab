"""The connections of one robot, and the links that they make.

There is a `Link` for each neighbour and any number of sessions, of which at most one is a link's own. What happens to
sessions becomes states of links, calls of the overlays, and actions.
"""

from collections import Counter
from collections.abc import Callable, Iterable
from functools import partial

from services.mesh.core.actions import Actions, Close, LinksChanged, Transmit
from services.mesh.core.calling import Calling
from services.mesh.core.link import (
    HandshakeFailed,
    LinkDown,
    LinkEvent,
    LinkRecovered,
    LinkSuspect,
    LinkUp,
    Received,
    neighbour,
)
from services.mesh.core.link.calls import REFUSED, Caller, Local
from services.mesh.core.link.clock import ClockSync
from services.mesh.core.link.neighbour import Holds, Link, Prober
from services.mesh.core.link.outbox import name_of
from services.mesh.core.link.session import DOWN, SUSPECT, Session
from services.mesh.core.overlays.robot_overlays import RobotOverlays
from services.mesh.core.wire import frames
from swarm.errors import FrameError
from swarm.messages import Echo, EchoRequest, HoldLink, LinkState


class Connections:
    """The connections of one robot. Calls with `now` must not go back in time; no call may overlap another."""

    def __init__(
        self,
        local: Local,
        overlays: RobotOverlays,
        actions: Actions,
        *,
        admit: Callable[[str, int, str], bool],
        serve: Callable[[], None],
        set_peers: Callable[[Iterable[str]], None],
        random: Callable[[], float],
        nonce: Callable[[], bytes],
        counters: Counter[str],
    ) -> None:
        """`admit(peer, overlay, key)` says whether a peer may use a channel. `serve()` is called whenever the overlays
        may have something to do, `set_peers(names)` with the neighbours when they are others than before."""
        assert overlays.linking is not None
        self._linking = overlays.linking
        self._local = local
        self._random = random
        self._overlays = overlays
        self._actions = actions
        self._serve = serve
        self._set_peers = set_peers
        self._nonce = nonce
        self._counters = counters
        self.links: dict[str, Link] = {}
        self._holds = Holds()
        self.prober = Prober(local.robot, local.dials)
        self.clock = ClockSync(local.robot, local.incarnation, local.robots)
        self._calling = Calling(local, overlays.linking, self.links, actions, random)
        self._session = partial(
            Session,
            local,
            admit=admit,
            clock=self.clock,
            counters=counters,
            may_call=self._calling.may_call,
            has_room=overlays.linking.has_room,
            is_held=self._holds.holds,
            clash=self._clash,
        )
        self._sessions: list[Session] = []
        self._ready: list[Session] = []

    # -- what transports and operators say -------------------------------------------------------------------

    def accepted(self, caller: Caller, now: float) -> Session | None:
        """Somebody connected; None = no handshake with this one, close it."""
        if (refusal := self._calling.refusal(caller, now)) is not None:
            counter, problem, text = refusal
            self._counters[counter] += 1
            self._actions.log_once(problem, text)
            return None
        if self._calling.is_knock(caller.robot or "", now):
            return None
        session = self.open(None, now, caller.robot)
        self._calling.begun(session, caller)
        return session

    def open(self, peer: str | None, now: float, expected: str | None = None) -> Session:
        """Begin a handshake; `peer` is whom we called, `expected` the robot that a caller's address belongs to."""
        self._calling.called(peer or "", now)
        patience = self._calling.patience(peer or "")
        session = self._session(self._nonce(), now, dialled=peer, expected=expected, patience=patience)
        self._sessions.append(session)
        self._ready.append(session)
        return session

    def dial_failed(self, peer: str, reason: str, now: float) -> None:
        """The connection that we asked for could not be made."""
        page = self._calling.called(peer, now)
        if (link := self.links.get(peer)) is not None:
            # A neighbour that others reach is no absent one: what waits for this link waits for each call. Where other
            # links than the graph's carry it, nothing waits.
            absent = self._local.pages and (self._linking.carried or not self._linking.is_reachable(peer))
            link.failed(reason, now, page if absent else 0.0)
            self._actions.add(LinksChanged())
        self._overlays.dial_failed(peer, reason, now)
        self._serve()

    def receive(self, session: Session, data: bytes, now: float) -> None:
        """Bytes arrived on a session's transport."""
        session.receive(data, now)
        self._digest(session, now)

    def transport_down(self, session: Session, reason: str, now: float) -> None:
        """End a session whose transport has ended; ignored where it had ended before."""
        if session.state != DOWN:
            self._counters["transport_lost"] += 1
            session.transport_down(reason)
            self._digest(session, now)

    def ping(self, request: EchoRequest, now: float) -> None:
        """Measure a link; the answers come out of `actions` as messages for the own bus."""
        link = self.links.get(request.peer)
        if (refusal := self.prober.ping(request, link, now)) is not None:
            self._actions.add(self.prober.told(refusal))
        if link is not None and link.session is not None:
            self._ready.append(link.session)

    def hold(self, request: HoldLink, now: float) -> None:
        """Have no link with a neighbour for a while, or let it come back."""
        if request.peer not in self._local.dials:
            self._actions.log_once(f"hold {request.peer}", f"no link to hold: {request.peer[:80]!r}")
            return
        held = self._holds.take(request, now)
        self._actions.log_link(
            f"link {'held down' if held else 'let up'} peer={request.peer} seconds={request.seconds:g}"
        )
        for session in tuple(self._sessions):
            if held and session.peer == request.peer:
                session.close(frames.HELD, frames.BYE_TEXT[frames.HELD])
                self._digest(session, now)

    def handle_timer(self, now: float) -> None:
        """Do everything that is due at `now`."""
        for session in tuple(self._sessions):
            session.handle_timer(now)
            self._digest(session, now)
        self._calling.handle_timer(now)
        if (peer := self._calling.to_knock_at(now)) is not None:
            self.connect(peer, once=True)

    def look_at_links(self, now: float) -> None:
        """End young links with the second robot of a name, and tell the overlays the round trips of the others."""
        for peer, link in tuple(self.links.items()):
            if (session := link.session) is None:
                continue
            if reason := self._overlays.clashes.check_link(peer, session.process, link.since, now):
                self._end(link, session, frames.CLASH, reason, now)
                self._actions.log_link(f"link down peer={peer} reason={reason}")
                continue
            if (rtt := session.pulse.rtt) is not None:
                self._overlays.measured(peer, rtt, now)
            self._calling.supervise(peer, session)
        self._name_clashes(now)

    def close(self, now: float) -> None:
        """End all connections: this robot's mesh stops."""
        for session in tuple(self._sessions):
            session.close(frames.CLOSING, "stopping")
            self._digest(session, now)

    # -- what the node wants ---------------------------------------------------------------------------------

    def send(self, peer: str, priority: int, key: str, payload: bytes, *, latest: bool) -> None:
        """Send a value to a neighbour; dropped and counted while its link is down."""
        if (link := self.links.get(peer)) is None:
            return
        if (session := link.session) is None:
            self._counters["no_link"] += 1
            link.dropped += 1
            return
        session.queue.push(priority, key, payload, latest=latest)
        self._ready.append(session)

    def transmit(self, packet: Transmit) -> bool:
        """Send a packet of the overlays; False where the queue of the link has no room for it."""
        session = self._session_of(packet.peer)
        if session is None or not session.is_up:
            return True
        self._ready.append(session)
        return session.queue.push(
            packet.priority, name_of(packet.overlay, packet.key), packet.payload, latest=packet.latest
        )

    def connect(self, peer: str, *, once: bool) -> None:
        """Have a link with a neighbour from now on, or only try to call it once."""
        link = self.links.setdefault(peer, Link(peer))
        if once:
            self._calling.call(link, self._overlays.now)
            return
        link.keep(self._random if self._local.dials.get(peer) else None)
        self._links_changed()

    def disconnect(self, peer: str, code: int) -> None:
        """Have no link with a robot any more."""
        if (link := self.links.get(peer)) is not None and link.session is not None:
            self._end(link, link.session, code, frames.BYE_TEXT[code], self._overlays.now)
        if self.links.pop(peer, None) is not None:
            self._links_changed()

    # -- outputs ---------------------------------------------------------------------------------------------

    def ready(self) -> list[Session]:
        """Sessions that have had something to send since the last call."""
        ready, self._ready = self._ready, []
        return ready

    def states(self) -> tuple[LinkState, ...]:
        """Return the state of all links, sorted by peer."""
        links = [link for _, link in sorted(self.links.items()) if link.lasting or link.session is not None]
        return tuple([link.state() for link in links])

    def next_deadline(self) -> float:
        """Return the time at which a session or a dialler has something to do."""
        # After each packet of an overlay, so without lists, generators and calls for each link.
        earliest = self._calling.next_deadline()
        for session in self._sessions:
            if session.deadline < earliest:
                earliest = session.deadline
        return earliest

    # -- inside ----------------------------------------------------------------------------------------------

    def _links_changed(self) -> None:
        self._set_peers(link.peer for link in self.links.values() if link.lasting or link.session is not None)
        self._actions.add(LinksChanged())

    def _digest(self, session: Session, now: float) -> None:
        """Turn a session's events into actions and into states of links."""
        for event in session.events():
            if type(event) is Received:
                assert session.peer is not None
                if event.overlay != frames.NEIGHBOURS:
                    self._overlays.receive(session.peer, event.overlay, event.key, event.payload, event.priority, now)
                    self._serve()
                elif self.prober.sender(event.key) is not None:
                    self._on_probe(session, event, now)
                else:
                    self._actions.add(event)
            else:
                self._on_event(session, event, now)
                if type(event) is LinkUp and self._session_of(event.peer) is not session:
                    break  # it was refused: what it has sent behind its handshake is void
        if session.state == DOWN:
            self._remove(session)
        elif session.wants_to_send:
            self._ready.append(session)

    def _on_probe(self, session: Session, event: Received, now: float) -> None:
        """Take a ping that is to be answered, or an answer to one. Other messages are dropped."""
        try:
            result = self.prober.receive(event.key, event.payload, now)
        except FrameError as error:
            self._counters["inbound_refused"] += 1
            self._actions.log_once(f"echo from {session.peer}", f"echo refused peer={session.peer} reason={error}")
            return
        if isinstance(result, Echo):
            self._actions.add(self.prober.told(result))
        elif result is not None and session.is_up:
            session.queue.push(event.priority, neighbour.pong_key(self._local.robot), result, latest=False)

    def _on_event(self, session: Session, event: LinkEvent, now: float) -> None:
        peer = session.peer
        match event:
            case LinkUp(name):
                self._calling.confirmed(session)
                if clash := self._clash(name, session.process, now):
                    # Another one has made its link while this one's handshake was under way.
                    self._on_failed(session, clash, frames.CLASH, None, now)
                    session.close(frames.CLASH, clash)
                    session.events()
                    self.clock.lost(name)  # its claim may have come with its handshake
                    return
                if (old := self.links.get(name)) is not None and old.session is not None:
                    # It was started anew, perhaps: no need to wait for silence.
                    self._end(old, old.session, frames.REPLACED, "replaced by a newer connection", now)
                link = self.links.setdefault(name, Link(name))
                link.attach(session, now)
                self._calling.supervise(name, session)
                if self._overlays.link_up(name, now):
                    self._actions.log_link(f"link up peer={name} connection={link.connection}")
                    self._links_changed()
                elif link.lasting:  # it is wanted, and called again when there is room
                    self._end(link, session, frames.FULL, frames.BYE_TEXT[frames.FULL], now)
                    self._links_changed()
                else:
                    self.disconnect(name, frames.UNWANTED)
                self._serve()
            case LinkSuspect():
                self._actions.log_link(f"link suspect peer={peer}")
            case LinkRecovered():
                self._actions.log_link(f"link heard again peer={peer}")
            case LinkDown(reason, code, said):
                assert peer is not None
                self._hear(peer, said, now)
                if code in (frames.BAD_FRAME, frames.BAD_TAG):
                    self._actions.log_once(f"{peer} {code}", f"connection ended peer={peer} reason={reason}")
                if (down := self.links.get(peer)) is not None and down.session is session:
                    self._detach(down, session, reason, now)
                    self._actions.log_link(f"link down peer={peer} reason={reason}")
            case HandshakeFailed(reason, code, said):
                self._on_failed(session, reason, code, said, now)

    def _session_of(self, robot: str) -> Session | None:
        link = self.links.get(robot)
        return None if link is None else link.session

    def _clash(self, robot: str, process: int, now: float) -> str:
        """Return why a robot's process may have no link because another robot has its name; empty where it may."""
        session = self._session_of(robot)
        if session is not None and session.state == SUSPECT and session.process not in (0, process):
            return ""  # it was started anew, perhaps: no need to wait for silence
        return self._overlays.clashes.refusal(robot, process, session.process if session is not None else 0, now)

    def _name_clashes(self, now: float) -> None:
        """Say in the log and in the link state which names two robots have."""
        self._overlays.tell_clashes(now)
        for robot, text in self._overlays.clashes.named(now).items():
            self._actions.log_once(f"clash {robot}", text)

    def _hear(self, peer: str, said: int | None, now: float) -> None:
        """Take the code that the other end gives when it ends a connection."""
        if said == frames.CLASH:
            text = f"{peer} refuses a link with this one"
            self._overlays.clashes.seen(self._local.robot, self._local.process, text, now)

    def _on_failed(self, session: Session, reason: str, code: int | None, said: int | None, now: float) -> None:
        caller, source = self._calling.failed(session, now, refused=code is not None)
        if code is not None:
            if session.peer in self.links:
                self.links[session.peer].refused += 1
            # One line for all strangers: who calls from many addresses must not fill the log. A clash of names has its
            # own, once it is sure.
            if code != frames.CLASH:
                address = f" address={source}" if source else ""
                self._actions.log_once(f"{caller} {code}", f"connection refused peer={caller}{address} reason={reason}")
        elif session.peer is not None and said in REFUSED:
            # Who calls may have told its name and then why it wants no link after all.
            self._hear(session.peer, said, now)
            if (link := self.links.get(session.peer)) is not None and link.session is None:
                link.reason = reason
            if said != frames.CLASH:
                self._actions.log_once(
                    f"{caller} says {said}", f"connection refused by peer={session.peer} reason={reason}"
                )
        if frames.CLASH in (code, said):
            self._name_clashes(now)
        if session.dialled is not None:
            if code == frames.SILENT and (called := self.links.get(session.dialled)) is not None:
                called.unanswered += 1
            self.dial_failed(session.dialled, reason, now)

    def _end(self, link: Link, session: Session, code: int, reason: str, now: float) -> None:
        """Close the connection of a link from our side."""
        self._detach(link, session, reason, now)
        session.close(code, reason)
        session.events()
        self._remove(session)

    def _detach(self, link: Link, session: Session, reason: str, now: float) -> None:
        self.clock.lost(link.peer)
        self._overlays.clashes.link_down(link.peer)
        link.detach(session, reason, now)
        self._calling.lost()
        self._overlays.link_down(link.peer, now)
        self._serve()

    def _remove(self, session: Session) -> None:
        if session in self._sessions:
            self._sessions.remove(session)
            self._actions.add(Close(session))
