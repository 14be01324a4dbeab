"""Lockstep: every robot computes x(k+1) from its own x(k) and all its neighbours' x(k), equal bit for bit.

One message per neighbour and iteration; no acknowledgement, no poll, no leader. Whatever is lost, cut, killed
or duplicated, the trajectory stays that of the undisturbed synchronous run, or the core says `Fault`:
it never forks in silence. `docs/reference/network/lockstep.md` has the rules R1-R9 that the comments name, and why they
are so.

Why two values suffice. A robot at k has used every neighbour's x(k-1), so each of them is at k-1 or later and
wants our x(k-1) or a later one; and it cannot pass k+1 without our x(k+1). A frame with x(k) and x(k-1) thus
serves every neighbour wherever it is, and k and k+1 are the only slots a neighbour's value can fall into.

The core is pure: bytes and `now` (seconds on any monotonic clock) go in, `actions()` come out and are to be
carried out in that order. It is not thread-safe: the host holds one lock around it, or uses one thread.
"""

from collections import Counter
from collections.abc import Iterable

from swarm.core.lockstep.actions import Action, Advanced, Compute, Fault, Finished, Save, Send, Waiting
from swarm.core.lockstep.frames import (
    MAX_ITERATION,
    Channel,
    HeardNeighbour,
    Snapshot,
    Step,
    Want,
    decode_frame,
    encode_step,
    encode_want,
)
from swarm.core.lockstep.links import SilentLinks
from swarm.core.lockstep.questions import QuestionTimes
from swarm.errors import FrameError, LocalError

NAME_AFTER = 2.5
"""Seconds without progress after which the robots that are waited for are named; 3 s are promised, the bus takes
some."""
LINGER = 10.0
"""Seconds that a robot that has finished stays for neighbours that may lack its values."""
LINGER_PATIENCES = 5.0
"""... or so many times as long as it waits until it asks, where that is more."""
RTT = 0.06
"""Round trip assumed where the host knows no better, in seconds: twice the latency of an RFCOMM link."""


class Lockstep:
    """The synchronous overlay of one robot in one epoch of one run.

    Make it, call `start()` or `resume()` once, then feed it. `counters` tells what was dropped and asked for.
    """

    def __init__(
        self,
        me: str,
        neighbours: Iterable[str],
        channel: Channel,
        size: int,
        *,
        last: int | None = None,
        rtt: float = RTT,
        linger: float = LINGER,
    ) -> None:
        self.me = me
        self.channel = channel
        self.rtt = rtt
        self.k = -1
        self.fault: str | None = None
        self.done = False
        self.counters: Counter[str] = Counter()
        self._peers = {name: HeardNeighbour() for name in sorted(neighbours)}
        self._size = size
        self._last = MAX_ITERATION if last is None else last
        self._linger = linger
        self._value = b""
        self._previous: bytes | None = None
        self._frame = b""
        """The `Step` of this iteration."""
        self._computing = False
        self._named: tuple[str, ...] = ()
        self._name_at = 0.0
        self._questions = QuestionTimes()
        self._leave_at = 0.0
        self._answered: dict[str, tuple[int, float]] = {}
        self._links = SilentLinks()
        self._actions: list[Action] = []
        if me in self._peers:
            raise LocalError(f"lockstep: {me} cannot be its own neighbour")
        if len(self._peers) > 255:
            raise LocalError(f"lockstep: {len(self._peers)} neighbours, at most 255 are possible")
        if not 0 <= self._last <= MAX_ITERATION:
            raise LocalError(f"lockstep: last iteration {last}, expected 0 to {MAX_ITERATION}")

    # What the host asks

    @property
    def waiting_for(self) -> tuple[str, ...]:
        """Neighbours whose value is missing for the next step, sorted."""
        return () if self.k == self._last else self._lacking()

    def actions(self) -> list[Action]:
        """Return the actions to be done now, in this order; each is handed out once."""
        actions, self._actions = self._actions, []
        return actions

    def next_deadline(self) -> float | None:
        """Return the time, on the clock of `now`, at which the host must call `handle_timer`; None while no timer
        runs."""
        if self.k < 0 or self.fault is not None or self.done:
            return None
        if self._computing:
            return None  # all values were there
        lacking = self._lacking()  # once: this is asked after each frame
        if self.k == self._last:
            return min(self._questions.due, self._links.due, self._leave_at) if lacking else self._leave_at
        if not lacking:
            return None
        asks_at = min(self._questions.due, self._links.due)
        return asks_at if self._named or asks_at < self._name_at else self._name_at

    # What the host tells

    def start(self, x0: bytes, now: float, private: bytes = b"", k: int = 0) -> None:
        """Begin at iteration 0, or that of a change of epoch, with the packed state `x0`; `private` comes back after
        a restart."""
        self._check_fresh()
        # The frame has room for two states. Of this epoch nobody has one before the first, nor will ever ask for it.
        self._enter(k, x0, x0 if k else None, now)
        if not k:
            # Neighbours are yet to start. Who does sends x(0), and our x(1) has x(0) beside it for whoever missed ours.
            self._questions.wait_for_start(now)
        self._actions.append(Save(self._snapshot(private)))
        self._broadcast()
        self._settle(now)

    def resume(self, saved: bytes, now: float, *, last: bool = False) -> bytes:
        """Go on from the last `Save` of an earlier incarnation; returns the private bytes in it. `last`: it was taken
        where all robots stop.

        `LocalError` where the snapshot is not whole or belongs to another run, epoch, app or topology.
        """
        self._check_fresh()
        snapshot = Snapshot.decode(saved)
        snapshot.check(self.channel, self._size, self._peers)
        if snapshot.k > self._last:
            raise LocalError(f"snapshot: at iteration {snapshot.k}, beyond the last one, {self._last}")
        self._peers = snapshot.heard
        if last:
            self._last = snapshot.k
        self._enter(snapshot.k, snapshot.value, snapshot.previous, now)
        self._broadcast()
        self._ask(self._lacking(), now)
        self._settle(now)
        return snapshot.private

    def computed(self, x_next: bytes, private: bytes, now: float, *, last: bool = False) -> None:
        """Answer a `Compute` with the packed x(k+1) and the private state that belongs to it. `last`: all robots have
        agreed to stop there."""
        if self.fault is not None:
            return  # The fault came while the step was running: its value must not get out.
        if not self._computing:
            raise LocalError("lockstep: computed() without a Compute to answer")
        self._computing = False
        if last:
            self._last = self.k + 1
        self._enter(self.k + 1, x_next, self._value, now)
        spent = (self.k - 2) % 3
        for peer in self._peers.values():
            peer.slots[spent] = None
        self._actions.append(Save(self._snapshot(private)))
        self._broadcast()
        self._settle(now)

    def nudge(self, now: float) -> None:
        """Ask at once for values that have been missing for a round trip: a link or the bus came up (R4)."""
        self._questions.hurry(now, self._name_at - NAME_AFTER, self.rtt)

    def handle_timer(self, now: float) -> None:
        """Do what is due at `now`; may be called at any time."""
        if self.k < 0 or self.fault is not None or self.done:
            return
        lacking = self._lacking()
        if now >= self._links.due:
            for name in self._links.silent():
                if name in lacking:
                    self._go_around(name)
                    self._send_around(name)
        if lacking and now >= self._questions.due:
            # With the own frame beside the question: the peer may be waiting for just that (R4).
            self._actions += [Send(self._frame, name) for name in lacking]
            self._ask(lacking, now)
            for name in self._links.around:
                if name in lacking:
                    self._send_around(name)
        waiting = self.waiting_for
        if waiting and now >= self._name_at:
            self._name(waiting)
        if self.k == self._last and now >= self._leave_at:
            self.done = True

    def receive(self, sender: str, channel: Channel, data: bytes, now: float, *, around: bool = False) -> None:
        """Take a frame of `sender` from `channel`; `around`: it has not come over the link with it. What is of no use
        is dropped and counted, never raised."""
        if self.k < 0:
            raise LocalError("lockstep: start() or resume() comes first")
        own = self.channel
        if channel.run != own.run:
            self.counters["other run"] += 1
        elif channel.epoch != own.epoch:
            self.counters["other epoch"] += 1
        elif channel.schema != own.schema:
            self.counters["other version"] += 1
        elif sender == self.me:
            self._receive_own(channel)
        elif (peer := self._peers.get(sender)) is None:
            self.counters["unknown sender"] += 1
        else:
            try:
                frame = decode_frame(data, self._size)
            except FrameError:
                self.counters["malformed"] += 1
                return
            if self._links.matter and not around:
                self._links.speaks(sender)
            if channel.incarnation < peer.incarnation:
                self.counters["old incarnation"] += 1
                if isinstance(frame, Step) and (at := peer.contradicted(frame, self.k)) is not None:
                    self._fail_of_two_values(sender, at)
            elif self.fault is None:
                useful = self._accept(sender, peer, channel.incarnation, frame)
                if around and useful:
                    # Whoever goes around has reason to, and is lacking what we say as we lacked this. A frame of no
                    # use may be one that the link has overtaken meanwhile.
                    self._go_around(sender)
            # An old WANT is a late copy, or of a robot that lost its state and perhaps its incarnation with it. Our
            # frame does nothing to the former and tells the latter that it is lost: so this one answer goes to an old
            # incarnation too, and even after a fault. A WANT of the next iteration, which we have not either, is
            # answered as a sign that the link carries.
            if isinstance(frame, Want) and (
                frame.k < self.k - 1 or (self.fault is None and channel.incarnation == peer.incarnation)
            ):
                self._answer(sender, frame.k, now, around=around)
            self._settle(now)

    # How it works

    def _receive_own(self, channel: Channel) -> None:
        """Take a frame of this robot: an echo of the bus, or of a second process of the same app (R6)."""
        if channel.incarnation > self.channel.incarnation:
            self._fail(
                f"another process runs this app on {self.me} "
                f"(incarnation {channel.incarnation}, this one is {self.channel.incarnation})"
            )
        else:
            self.counters["own frame"] += 1

    def _accept(self, sender: str, peer: HeardNeighbour, incarnation: int, frame: Step | Want) -> bool:
        """Learn from a frame of the newest incarnation (R3); whether it held a value that was missing."""
        restarted = incarnation > peer.incarnation
        peer.incarnation = incarnation
        if frame.k > peer.reached:
            peer.reached = frame.k
        if frame.k < self.k:
            self._questions.is_late(sender)
        if frame.k > self.k + 1:
            # To get there it must have had our x(k+1): we have forgotten that we sent it.
            self._fail(f"state lost at {self.me}: {sender} is at iteration {frame.k}, this robot at {self.k}")
        elif frame.k < self.k - 1:
            # We used its x(k-1), which it wrote down before it sent it. An older frame is a late copy, unless
            # it is the first one of a process that should have read that file.
            if restarted:
                self._fail(
                    f"state lost at {sender}: it came back at iteration {frame.k} "
                    f"(incarnation {incarnation}), this robot is at {self.k}"
                )
            self.counters["late"] += 1
        elif isinstance(frame, Step):
            new = False
            values = [(frame.k, frame.value)]
            if frame.previous is not None and frame.k >= self.k:
                values.insert(0, (frame.k - 1, frame.previous))
            for k, value in values:
                held = peer.slots[k % 3]
                if held is None:
                    if k >= self.k:
                        peer.slots[k % 3] = value
                        new = True
                elif held != value:
                    self._fail_of_two_values(sender, k)
            if new:
                return True
            self.counters["duplicate"] += 1
        return False

    def _fail_of_two_values(self, sender: str, k: int) -> None:
        self._fail(f"two values for one iteration: {sender} sent two different states for iteration {k}")

    def _fail(self, reason: str) -> None:
        if self.fault is None:
            self.fault = reason
            self._computing = False
            self._actions.append(Fault(reason))

    def _enter(self, k: int, value: bytes, previous: bytes | None, now: float) -> None:
        """Be at iteration k; all clocks run from here: progress of the own k alone winds them (hole 1)."""
        if self.k > 0:  # at the first one neighbours are yet to start
            self._questions.took(self._name_at - NAME_AFTER, now, self.rtt)
        if len(value) != self._size:
            raise LocalError(f"lockstep: a state of {len(value)} bytes, expected {self._size}")
        self.k, self._value, self._previous = k, value, previous
        self._frame = encode_step(k, value, previous)
        self._links.progress()
        self._questions.progress(now, self.rtt)
        self._name_at = now + NAME_AFTER
        self._leave_at = now + max(self._linger, LINGER_PATIENCES * self._questions.interval)

    def _broadcast(self) -> None:
        if self._peers:
            self._actions.append(Send(self._frame, None))
        self._actions += [Send(self._frame, name, around=True) for name in self._links.around]
        self._actions.append(Advanced(self.k, self._value))
        if self.k == self._last:
            self._actions.append(Finished(self.k))

    def _settle(self, now: float) -> None:
        """Report a wait that ended or has fewer robots, compute, or be done; called after any change."""
        if self.fault is not None or self._computing:
            return
        if self.k == self._last:
            if not self._lacking():
                self.done = True
            return
        if self._named:
            self._name(self._lacking())
        place, values = self.k % 3, {}
        for name, peer in self._peers.items():
            if (value := peer.slots[place]) is None:
                return  # after each frame but the last one of an iteration: whom else it lacks nobody asks here
            values[name] = value
        self._computing = True
        self._actions.append(Compute(self.k, self._value, values))

    def _lacking(self) -> tuple[str, ...]:
        """Neighbours whose x(k) is missing; at the last iteration those not known to be there (R7)."""
        if self.k == self._last:
            return tuple([name for name, peer in self._peers.items() if peer.reached < self.k])
        place = self.k % 3  # a loop: after each frame, and mostly of nobody
        lacking: tuple[str, ...] = ()
        for name, peer in self._peers.items():
            if peer.slots[place] is None:
                lacking += (name,)
        return lacking

    def _ask(self, peers: tuple[str, ...], now: float) -> None:
        """Ask each of `peers` for its x(k); ask again later and later, for ever (R4)."""
        self._actions += [Send(encode_want(self.k), name) for name in peers]
        self.counters["want sent"] += len(peers)
        # At the first iteration neighbours are yet to start.
        self._links.asked(peers, self.rtt, now, least=now if self.k else self._name_at)
        self._questions.asked(peers, now, self.rtt)

    def _go_around(self, peer: str) -> None:
        if self._links.go_around(peer):
            self.counters["links gone around"] += 1

    def _send_around(self, peer: str) -> None:
        """Send a neighbour our value, and the question for its value, around the link with it."""
        self._actions += (Send(self._frame, peer, around=True), Send(encode_want(self.k), peer, around=True))

    def _answer(self, sender: str, k: int, now: float, *, around: bool) -> None:
        """Send the own frame to who asked, the way it asked, at most once per (peer, k) and round trip (R4)."""
        asked, at = self._answered.get(sender, (-1, 0.0))
        if asked == k and now - at < self.rtt:
            self.counters["want suppressed"] += 1
            return
        self._answered[sender] = (k, now)
        self.counters["want answered"] += 1
        self._actions.append(Send(self._frame, sender, around=around))

    def _name(self, peers: tuple[str, ...]) -> None:
        if peers != self._named:
            self._named = peers
            self._actions.append(Waiting(self.k, peers))

    def _snapshot(self, private: bytes) -> Snapshot:
        channel = self.channel
        return Snapshot(
            run=channel.run,
            epoch=channel.epoch,
            schema=channel.schema,
            size=self._size,
            k=self.k,
            value=self._value,
            previous=self._previous,
            heard=self._peers,
            private=private,
        )

    def _check_fresh(self) -> None:
        if self.k >= 0:
            raise LocalError("lockstep: start() and resume() are for a new core, this one runs")
