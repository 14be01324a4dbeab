"""A connection of two neighbours, from the moment bytes can flow until they cannot.

    connecting --HELLO and CONFIRM of the other end--> up <--silence/bytes--> suspect
        any --transport lost, bad frame, BYE, silence--> down (for good: the next connection is a new session)

Both ends send HELLO at once. Who accepts the other's HELLO sends CONFIRM, and a link is up on one side when
the other's CONFIRM arrived: so a peer that refuses us never looks up for a moment, and one without the key never
gets beyond this object. Frames are made when they leave (`data_to_send`), not when they are queued: priorities
act until the last moment, heartbeats carry the true time, and the counter of the tags follows the order on the
wire.
"""

from collections import Counter
from collections.abc import Callable

from services.mesh.core.link import (
    HandshakeFailed,
    LinkDown,
    LinkEvent,
    LinkRecovered,
    LinkSuspect,
    LinkUp,
    Received,
    calls,
    flow,
)
from services.mesh.core.link.clock import ClockSync, decode_claim, encode_claim
from services.mesh.core.link.outbox import SENT, WIRE_CLASS, Channels, Outbox, OutgoingPart, QueuedMessage, overlay_of
from services.mesh.core.link.round_trips import Pulse
from services.mesh.core.wire import frames
from services.mesh.core.wire.auth import Keys, newest_common
from services.mesh.core.wire.frames import BULK, BYE_TEXT, Frame, Hello
from swarm.errors import FrameError

CONNECTING, UP, SUSPECT, DOWN = "connecting", "up", "suspect", "down"

_NEVER = float("inf")


class Session:
    """One connection. Calls with `now` must not go back in time."""

    def __init__(
        self,
        local: calls.Local,
        nonce: bytes,
        now: float,
        *,
        dialled: str | None,
        admit: Callable[[str, int, str], bool],
        clock: ClockSync,
        counters: Counter[str],
        expected: str | None = None,
        patience: float | None = None,
        may_call: Callable[[str], bool] = lambda robot: False,
        has_room: Callable[[str], bool] = lambda robot: True,
        is_held: Callable[[str, float], bool] = lambda robot, now: False,
        clash: Callable[[str, int, float], str] = lambda robot, process, now: "",
    ) -> None:
        """Bytes can flow from `now` on. `dialled` names whom we called, None where we were called;
        `expected` names the robot whose address a caller has, where the transport knows it (Bluetooth does);
        `patience`: s for HELLO, and then for CONFIRM of the other end to arrive.

        `admit(peer, overlay, key)` says whether that peer may use a channel, `may_call(robot)` whether a robot that we
        dial may call us, `has_room(robot)` whether a robot may have a link with us now, `is_held(robot, now)` whether
        an operator wants none, `clash(robot, process, now)` why a robot's process may have none, where another robot
        has its name.
        """
        self._local = local
        self._may_call = may_call
        self._has_room = has_room
        self._is_held = is_held
        self._clash = clash
        self._admit = admit
        self._clock = clock
        self._counters = counters
        self.dialled = dialled
        self._expected = expected
        self.peer = dialled
        """The robot at the other end; None until an unknown caller's HELLO was accepted."""
        self.state = CONNECTING
        self.pulse = Pulse(now)
        self.sent = 0
        """Frames handed out to be sent."""
        self.received = 0
        self._incarnation: int | None = None
        self._decoder = frames.FrameDecoder()
        self._events: list[LinkEvent] = []
        self.queue = Outbox(counters)
        """What waits to leave."""
        self.window = flow.SendWindow()
        """What is under way."""
        self._receipts = flow.Receipts()
        self._reassembly = flow.Reassembly(counters)
        self._channels = Channels()
        self._bound: dict[int, tuple[str, int] | None] = {}
        ids = tuple(sorted(local.keys, reverse=True))
        self._hello = frames.encode_hello(
            Hello(local.network, local.robot, local.incarnation, nonce, dialled is not None, local.insecure, ids)
        )
        self._urgent = [self._hello]
        self._auth: Keys | None = None
        """The keys of this connection, once the other's HELLO was accepted; None on insecure links."""
        self._confirm = b""
        self._began = now
        self._patience = patience or local.times.handshake
        self._heard = now
        self._heartbeat_at = now
        self._heartbeat_due = False
        self.supervised = 0.0
        """Seconds of silence after which the transport was told to give the connection up; 0 before it was."""
        self.deadline = now + self._patience
        """The time at which `handle_timer` wants to be called, s; the call may be early, never late."""

    @property
    def is_up(self) -> bool:
        """Whether messages pass; a suspect link still carries them."""
        return self.state in (UP, SUSPECT)

    @property
    def dead_after(self) -> float:
        """Seconds of silence after which the link ends."""
        return self.pulse.dead_after(self._local)

    @property
    def process(self) -> int:
        """The number of the mesh process at the other end; 0 before its HELLO was accepted."""
        return calls.process_of(self._incarnation or 0)

    @property
    def sent_bytes(self) -> int:
        """Bytes handed out to be sent."""
        return self.window.sent

    @property
    def received_bytes(self) -> int:
        """Bytes taken off the stream."""
        return self._receipts.taken

    @property
    def wants_to_send(self) -> bool:
        """Whether `data_to_send` has something, now or when the pace of bulk allows it."""
        if self._urgent or self._heartbeat_due or (self._receipts.due() and self.is_up):
            return True
        return self.queue.waiting > 0 and self.queue.leaves(self.window.free(0, _NEVER))

    @property
    def resumes(self) -> float:
        """The time at which bulk may leave that only its pace holds back, s; infinite where there is none."""
        window = self.window
        held = self.is_up and self.queue.bulk_waits and window.free(0, window.next_bulk) > 0
        return window.next_bulk if held else _NEVER

    def events(self) -> list[LinkEvent]:
        """Return the events since the last call."""
        events, self._events = self._events, []
        return events

    # -- inputs ------------------------------------------------------------------------------------

    def receive(self, data: bytes, now: float) -> None:
        """Take bytes from the transport, cut anyhow."""
        if self.state == DOWN:
            return
        self._receipts.taken += len(data)
        try:
            for frame in self._decoder.frames(data):
                self.received += 1
                # Whole frames only: whoever can add bytes to the stream must not keep a dead link looking alive.
                self._heard = now
                if self.state == SUSPECT:
                    self.state = UP
                    self._events.append(LinkRecovered())
                if frame.kind == frames.DATA and self.is_up:
                    self._on_data(frame)
                else:
                    self._on_control(frame, now)
                    if self.state == DOWN:
                        break
        except frames.VersionError as error:
            self._end(frames.BAD_VERSION, str(error))
        except frames.TagError as error:
            self._end(frames.BAD_TAG, str(error))
        except FrameError as error:
            self._end(frames.BAD_FRAME, f"bad frame: {error}")

    def transport_down(self, reason: str) -> None:
        """The transport is gone; nothing can be sent any more."""
        if self.state != DOWN:
            self._close(reason, None)

    def close(self, code: int, reason: str) -> None:
        """End the connection from our side and say why to the other."""
        if self.state != DOWN:
            self._end(code, reason)

    def handle_timer(self, now: float) -> None:
        """Heartbeats, and what silence means. Call it at `deadline` or any other time."""
        if self.state == CONNECTING:
            if now >= self.deadline:
                self._end(frames.SILENT, f"no handshake within {self._patience:g} s")
        elif self.is_up:
            # The same sums as in the deadline below: a difference could round to just short of it, for ever.
            dead = self.dead_after
            if now >= self._heard + dead:
                self._end(frames.SILENT, f"silent for {dead:.3g} s")
                return
            suspect = self.pulse.suspect_after(self._local)
            if now >= self._heard + suspect and self.state == UP:
                self.state = SUSPECT
                self._events.append(LinkSuspect())
            if now >= self._heartbeat_at:
                self._heartbeat_due = True
                self._heartbeat_at = self.pulse.next_beat(now, self._local.times.heartbeat, self._local.incarnation)
            self.deadline = min(self._heartbeat_at, self._heard + (dead if self.state == SUSPECT else suspect))

    def data_to_send(self, now: float, max_bytes: int) -> bytes:
        """Whole frames to be sent next, most urgent first; stops when `max_bytes` are reached or passed."""
        queue, receipts = self.queue, self._receipts
        if not (queue.waiting or self._urgent or self._heartbeat_due or receipts.due()):
            return b""
        chunks, self._urgent = self._urgent, []
        size = sum(map(len, chunks)) if chunks else 0
        bulk = False
        if self.is_up:
            beat, self._heartbeat_due = self._heartbeat_due, False
            if beat:
                self._beat(chunks, now)
            if (count := receipts.take(at_once=beat)) is not None:
                chunks.append(flow.encode_ack(count))
            window = self.window
            while queue.waiting and size < max_bytes:
                item = queue.pop(window.free(size, now), flow.FRAGMENT)
                if item is None:
                    break
                part = item if isinstance(item, OutgoingPart) else None
                message = item if isinstance(item, QueuedMessage) else item.message
                channel, new = self._channels.handle(message.key)
                if new:
                    chunks.append(frames.encode_bind(frames.Bind(channel, *overlay_of(message.key))))
                if part is None:
                    chunks.append(frames.encode_data(WIRE_CLASS[message.priority], channel, message.payload))
                elif new and part.number:
                    # So many other keys were used since its last part that the key has lost its handle.
                    queue.restart(part)
                    continue
                else:
                    total = 0 if part.number else len(message.payload)
                    chunks.append(
                        flow.encode_fragment(flow.Fragment(channel, part.number, part.last, total, part.data))
                    )
                size += len(chunks[-1])
                if part is None or part.last:
                    self._counters[SENT[message.priority]] += 1
                if message.priority == BULK:
                    bulk = True
                    if size >= flow.FRAGMENT:
                        break
        self.sent += len(chunks)
        data = b"".join(chunks) if self._auth is None else self._auth.seal(chunks, self._confirm)
        self.window.wrote(len(data), now, bulk=bulk, waits=queue.bulk_waits)
        return data

    def _beat(self, chunks: list[bytes], now: float) -> None:
        """Append a heartbeat, and the clock's claim, to what leaves."""
        assert self.peer is not None
        stamps = self.pulse.beat(now, self.sent_bytes, self.received_bytes)
        chunks += (frames.encode_heartbeat(stamps), encode_claim(self._clock.claim(self.peer, now)))
        self._reassembly.expire(now)

    # -- frames of the other end -------------------------------------------------------------------

    def _on_data(self, frame: Frame) -> None:
        channel, payload = frames.decode_data(frame.body)
        if frame.priority == BULK:
            self._receipts.bulk = True
        try:
            bound = self._bound[channel]
        except KeyError:
            raise FrameError(f"DATA on channel {channel}, which is not bound") from None
        if bound is None:
            self._counters["inbound_refused"] += 1
        else:
            key, overlay = bound
            self._events.append(Received(key, payload, frame.priority, overlay))

    def _on_fragment(self, frame: Frame, now: float) -> None:
        fragment = flow.decode_fragment(frame.body)
        self._receipts.bulk = True
        if fragment.channel not in self._bound:
            raise FrameError(f"FRAGMENT on channel {fragment.channel}, which is not bound")
        bound = self._bound[fragment.channel]
        if bound is None:
            self._counters["inbound_refused"] += fragment.number == 0
        elif (payload := self._reassembly.add(fragment, now)) is not None:
            key, overlay = bound
            self._events.append(Received(key, payload, BULK, overlay))

    def _on_control(self, frame: Frame, now: float) -> None:
        if frame.kind == frames.BYE:
            code = frames.decode_bye(frame.body)
            self._counters["byes"] += 1
            self._close(f"the other end says: {BYE_TEXT.get(code, f'code {code}')}", None, code)
        elif self._incarnation is None:
            if frame.kind != frames.HELLO:
                raise FrameError(f"frame kind {frame.kind} before HELLO")
            self._on_hello(frames.decode_hello(frame.body), frame, now)
        elif self.state == CONNECTING:
            if frame.kind != frames.CONFIRM:
                raise FrameError(f"frame kind {frame.kind} before CONFIRM")
            self._on_confirm(frame, now)
        elif frame.kind == frames.FRAGMENT:
            self._on_fragment(frame, now)
        elif frame.kind == frames.ACK:
            self.window.on_ack(flow.decode_ack(frame.body), now)
        elif frame.kind == frames.HEARTBEAT:
            assert self.peer is not None
            if (heard := self.pulse.heard(frames.decode_heartbeat(frame.body), now)) is not None:
                self._clock.sample(self.peer, now, *heard)
        elif frame.kind == frames.CLOCK:
            assert self.peer is not None
            self._clock.hear(self.peer, decode_claim(frame.body), now)
        elif frame.kind == frames.BIND:
            self._on_bind(frames.decode_bind(frame.body))
        else:
            raise FrameError(f"frame kind {frame.kind} after the handshake")

    def _on_hello(self, hello: Hello, frame: Frame, now: float) -> None:
        local = self._local
        key_id = newest_common(local.keys, hello.key_ids)
        refusal = calls.refusal(
            hello,
            local,
            dialled=self.dialled,
            expected=self._expected,
            may_call=self._may_call,
            has_room=self._has_room,
            is_held=lambda robot: self._is_held(robot, now),
            clash=lambda robot, process: self._clash(robot, process, now),
        )
        if refusal is not None:
            self._end(*refusal)
            return
        self.peer = hello.robot
        self._incarnation = hello.incarnation
        self.deadline = now + self._patience
        if key_id is not None:
            # The decoder takes nothing that `encode` would write differently, so this is the frame as it was sent.
            theirs = frames.encode(frame.kind, frame.priority, frame.body)
            dialler = self.dialled is not None
            self._auth = Keys(local.keys[key_id], key_id, frames.VERSION, self._hello, theirs, dialler=dialler)
        self._confirm = frames.encode_confirm(b"" if self._auth is None else self._auth.confirm)
        self._urgent.append(self._confirm)

    def _on_confirm(self, frame: Frame, now: float) -> None:
        auth = self._auth
        mac = frames.decode_confirm(frame.body, 0 if auth is None else frames.MAC_SIZE)
        if auth is not None:
            if not auth.confirms(mac):
                self._end(frames.BAD_KEY, f"who calls itself {self.peer} does not hold the key that it offers")
                return
            self._decoder.tag = auth.inbound
        self._on_up(now)

    def _on_up(self, now: float) -> None:
        assert self.peer is not None
        self.state = UP
        self._decoder.limit = frames.MAX_FRAME
        self.pulse.begin(now - self._began, now)
        self._events.append(LinkUp(self.peer))
        self._heartbeat_at = now
        self.deadline = now
        self.handle_timer(now)

    def _on_bind(self, bind: frames.Bind) -> None:
        assert self.peer is not None
        self._reassembly.drop(bind.channel)
        admitted = self._admit(self.peer, bind.overlay, bind.key)
        self._bound[bind.channel] = (bind.key, bind.overlay) if admitted else None

    # -- the end -----------------------------------------------------------------------------------

    def _end(self, code: int, reason: str) -> None:
        """We end it: BYE is the last thing to be sent."""
        if code in calls.REFUSED:
            self._counters[calls.REFUSED[code]] += 1
        self._close(reason, code)
        self._urgent = [frames.encode_bye(code)]

    def _close(self, reason: str, code: int | None, said: int | None = None) -> None:
        was_up = self.is_up
        self.state = DOWN
        self.deadline = _NEVER
        self._urgent = []
        self._heartbeat_due = False
        self.queue.clear()
        self._events.append(LinkDown(reason, code, said) if was_up else HandshakeFailed(reason, code, said))
