"""The asynchronous overlay, and what an event-driven or periodic app does next. No IO, no clock.

Each robot tells its neighbours its newest state, whenever it has changed and once a second besides; nobody waits for
anybody. A frame travels under a key that ends in a channel (run, incarnation, version of the app): frames of another
run or of a dead process are dropped, and robots with another version of the app are named. Bytes of a frame:

    0     1  flags: bit 0 = all robots of the run have been there
    1     4  sequence, u32, little endian, from 1 for each process
    5        the state, at the fixed width of the app's
             unless all have been there: a bit for each robot, in the order of swarm.toml, bit 0 of the first byte
             first: those that the sender knows to have been there

Start barrier (thesis figure 3.9, there only among neighbours): each adds what it hears to what it knows. Whoever has
all bits, or hears a neighbour who has, may step; so a process that is started again in mid-run steps at once.

The app's handlers run one at a time: `actions` gives a `HandlerCall`, and the next one after `returned`.
"""

import math
import struct
from collections import Counter, deque
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from swarm.core.lockstep.frames import Channel
from swarm.errors import FrameError

REPEAT = 1.0
"""Seconds after which an unchanged state is told again: it mends losses, and shows that the app is alive."""
REPEAT_WAITING = 0.5
"""Seconds after which it is told again before the barrier."""
MIN_GAP = 0.01
"""Seconds between two frames at least: an app that changes its state more often sends every other one, and the last."""
DEAD_AFTER = 30.0
"""Seconds of silence after which a process counts as dead, so that one of a lower incarnation is heard: a robot with a
new card counts its starts anew."""
HANG = 10.0
"""Seconds after which a step or handler that still runs counts as hanging, in apps of all kinds."""
MAX_QUEUE = 256
"""Events that wait for their handler; beyond this the oldest ones from outside the app are lost."""
MAX_QUEUE_BYTES = 4 * 1024 * 1024
"""Bytes of messages that wait for their handler; beyond this the oldest events are lost, too."""

_HEAD = struct.Struct("<BI")
_ALL = 1
_ALWAYS = ("start", "step", "on_parameter")
_FROM_OUTSIDE = ("on_button", "on_message", "on_announced", "on_neighbour")


class HandlerCall(NamedTuple):
    """Call this handler of the app now, and say when it has returned."""

    handler: str
    """start, step, on_button, on_message, on_answer, on_announced, on_neighbour, on_parameter or on_timer."""
    arguments: tuple[object, ...] = ()
    """The arguments of the handler; a neighbour is given by name."""
    size: int = 0
    """Bytes of a message among the arguments."""


class Publish(NamedTuple):
    """Send a frame to all neighbours."""

    data: bytes


Action = HandlerCall | Publish


class NeighbourState(NamedTuple):
    """A neighbour's newest state."""

    name: str
    data: bytes
    age: float
    """Seconds since it was told."""


@dataclass(slots=True)
class _Peer:
    incarnation: int = -1
    sequence: int = 0
    data: bytes | None = None
    came: float = -math.inf
    stranger: bool = False
    """Whether it runs another version of the app."""


@dataclass
class Asynchronous:
    """One app on one robot. `begin` it, feed it, carry out its `actions`."""

    me: str
    neighbours: tuple[str, ...]
    channel: Channel
    """Run, incarnation and version of this process; the epoch is always 0."""
    size: int
    """Bytes of one packed state; 0 = the app shares none."""
    robots: Sequence[str]
    """All robots of the swarm, in the order of swarm.toml."""
    period: float | None = None
    """Seconds between two steps; None = the app has none."""
    barrier: bool = False
    """Whether steps wait until all robots have been there."""
    handled: Collection[str] | None = None
    """Handlers that the app has, of on_button, on_message, on_answer, on_neighbour and on_timer; None = all."""
    last: int | None = None
    """Number of steps after which it is done; None = it goes on."""

    counters: Counter[str] = field(default_factory=Counter)
    k: int = 0
    """Steps done, or events where the app has no steps."""
    failure: str = ""
    """Why it has stopped; empty where it has not."""

    def __post_init__(self) -> None:
        self._peers = {name: _Peer() for name in self.neighbours}
        self._bits = {name: 1 << place for place, name in enumerate(self.robots)}
        self._everyone = (1 << len(self.robots)) - 1
        self._roll_size = (len(self.robots) + 7) // 8
        self._roll = 0
        self._all_here = False
        self._state: bytes | None = None
        self._sequence = 0
        self._told_at = -math.inf
        self._tell_at = math.inf
        self._queue: deque[HandlerCall] = deque()
        self.running: HandlerCall | None = None
        """The handler that has not returned yet."""
        self._since = math.inf
        self._began = False
        self._done = False
        self._step_at = math.inf
        self._timers: dict[str, float] = {}
        self._actions: list[Action] = []

    # -- what it is

    @property
    def phase(self) -> str:
        """starting, waiting (for other robots), running, done or fault, at the time of the last call."""
        if self.failure:
            return "fault"
        if self._done:
            return "done"
        if self._state is None:
            return "starting"
        return "waiting" if self.missing else "running"

    @property
    def missing(self) -> tuple[str, ...]:
        """Robots that the barrier waits for."""
        if not self.barrier or self._all_here or self._state is None:
            return ()
        return tuple([name for name, bit in self._bits.items() if not self._roll & bit])

    @property
    def strangers(self) -> tuple[str, ...]:
        """Neighbours that run another version of the app: their state is not used."""
        return tuple([name for name, peer in self._peers.items() if peer.stranger])

    def hangs(self, now: float) -> bool:
        """Return whether a handler takes too long to be well. An app that has failed has another fault."""
        return self.running is not None and not self.failure and now - self._since >= HANG

    def known(self, now: float) -> list[NeighbourState]:
        """Return the newest states of the neighbours that have told one, sorted by name."""
        found = ((name, peer) for name, peer in sorted(self._peers.items()))
        return [NeighbourState(name, peer.data, now - peer.came) for name, peer in found if peer.data is not None]

    # -- what happens

    def begin(self, now: float) -> None:
        """The process is there: `start` is called."""
        self._add(HandlerCall("start"), now)

    def receive(self, sender: str, channel: Channel, data: bytes, now: float) -> None:
        """Take a frame of a neighbour. Damaged frames, and frames for others, are counted and dropped."""
        peer = self._peers.get(sender)
        if peer is None or channel.run != self.channel.run:
            self.counters["other_run" if peer else "not_a_neighbour"] += 1
            return
        if channel.incarnation < peer.incarnation and now < peer.came + DEAD_AFTER:
            self.counters["dead_process"] += 1
            return
        peer.stranger = channel.schema != self.channel.schema
        if peer.stranger:
            self.counters["other_version"] += 1
            return
        try:
            flags, sequence, state, roll = self._decode(data)
        except FrameError:
            self.counters["bad_frame"] += 1
            return
        if channel.incarnation != peer.incarnation:
            peer.incarnation = channel.incarnation
        elif sequence <= peer.sequence:
            self.counters["duplicate"] += 1
            return
        peer.sequence, peer.came = sequence, now
        self._hear(all_here=bool(flags & _ALL), roll=roll, now=now)
        if self.size and state != peer.data:
            peer.data = state
            self._add(HandlerCall("on_neighbour", (sender,)), now)

    def happened(self, handler: str, *arguments: object, now: float, size: int = 0) -> None:
        """Queue the handler of an event: a button, a message of `size` bytes, an answer or a parameter."""
        self._add(HandlerCall(handler, arguments, size), now)

    def after(self, seconds: float, name: str, now: float) -> None:
        """Call `on_timer(name)` in so many seconds; said again, it is moved."""
        self._timers[name] = now + seconds

    def set_neighbours(self, names: Sequence[str], now: float) -> None:
        """Replace the neighbours. Values of neighbours that stay are kept; new ones are told this state at once."""
        self.neighbours = tuple(names)
        self._peers = {name: self._peers.get(name) or _Peer() for name in self.neighbours}
        self._tell_soon(now)

    def set_period(self, period: float, now: float) -> None:
        """Step this often from now on."""
        self.period = period
        if self._step_at < math.inf:
            self._step_at = now + period

    def returned(self, state: bytes, now: float, *, finished: bool = False) -> None:
        """The handler has returned, and left this state; `finished`: the app has done its work."""
        call, self.running, self._since = self.running, None, math.inf
        if call is None or self.failure:
            return
        if call.handler == "step" or (self.period is None and call.handler != "start"):
            self.k += 1
        if call.handler == "start":
            self._roll |= self._bits[self.me]
            self._hear(all_here=False, roll=0, now=now)
        if state != self._state:
            self._state = state
            self._tell_soon(now)
        if finished or (self.last is not None and self.period is not None and self.k >= self.last):
            self._done = True
            self._queue.clear()
            self._timers.clear()
            self._step_at = math.inf
        elif call.handler == "start":
            self._began = True
            self._may_step(now)
        self.handle_timer(now)

    def fail(self, reason: str) -> None:
        """The app has misbehaved: nothing is called or told any more."""
        if not self.failure:
            self.failure = reason
        self._queue.clear()
        self._timers.clear()
        self._actions.clear()
        self._step_at = self._tell_at = math.inf

    def handle_timer(self, now: float) -> None:
        """Do what is due."""
        if self.failure:
            return
        for name in [name for name, at in self._timers.items() if at <= now]:
            del self._timers[name]
            self._add(HandlerCall("on_timer", (name,)), now)
        if now >= self._step_at and self.period is not None:
            # Missed steps are not made up for: the grid of deadlines stays, as many of them pass as have passed.
            passed = math.floor((now - self._step_at) / self.period) + 1
            self.counters["late_steps"] += passed - 1
            self._step_at += passed * self.period
            self._add(HandlerCall("step"), now)
        if now >= self._tell_at:
            if self.hangs(now):
                self._tell_at = now + REPEAT  # a time in the past would be planned again for ever
            else:
                self._tell(now)
        self._next(now)

    def next_deadline(self) -> float | None:
        """Return the latest time at which the host must call `handle_timer`; None while no timer runs."""
        due = min([self._step_at, self._tell_at, *self._timers.values()])
        # After a fault `handle_timer` does nothing: a time in the past would be planned again for ever.
        return None if self.failure or due == math.inf else due

    def actions(self) -> list[Action]:
        """Return the actions to be done now, in this order; each is handed out once."""
        actions, self._actions = self._actions, []
        return actions

    # -- inside

    def _decode(self, data: bytes) -> tuple[int, int, bytes, int]:
        if len(data) < _HEAD.size:
            raise FrameError(f"frame of {len(data)} bytes")
        flags, sequence = _HEAD.unpack_from(data)
        roll_size = 0 if flags & _ALL else self._roll_size
        if flags & ~_ALL or len(data) != _HEAD.size + self.size + roll_size:
            raise FrameError(f"frame of {len(data)} bytes with the flags {flags:#x}")
        end = _HEAD.size + self.size
        roll = int.from_bytes(data[end:], "little")
        if roll & ~self._everyone:
            raise FrameError("frame of a larger swarm")
        return flags, sequence, data[_HEAD.size : end], roll

    def _hear(self, *, all_here: bool, roll: int, now: float) -> None:
        """Take a neighbour's knowledge of which robots have been there."""
        if self._all_here:
            if not all_here:
                self._tell_soon(now)  # it does not know yet
            return
        before = self._roll
        self._roll |= roll
        self._all_here = all_here or self._roll == self._everyone
        if self._state is None:
            return
        if self._all_here or self._roll != before:
            self._tell_soon(now)
        self._may_step(now)

    def _may_step(self, now: float) -> None:
        free = not self.barrier or self._all_here
        if self._began and free and self.period is not None and self._step_at == math.inf and not self._done:
            self._step_at = now

    def _tell_soon(self, now: float) -> None:
        if self._state is not None:
            self._tell_at = min(self._tell_at, max(now, self._told_at + MIN_GAP))

    def _tell(self, now: float) -> None:
        assert self._state is not None
        self._sequence += 1
        flags = _ALL if self._all_here else 0
        roll = b"" if self._all_here else self._roll.to_bytes(self._roll_size, "little")
        self._actions.append(Publish(_HEAD.pack(flags, self._sequence) + self._state + roll))
        self._told_at = now
        self._tell_at = now + (REPEAT if self._all_here or not self.barrier else REPEAT_WAITING)

    def _add(self, call: HandlerCall, now: float) -> None:
        if self.failure or self._done:
            return
        if self.handled is not None and call.handler not in (*_ALWAYS, *self.handled):
            return
        if call.handler in ("on_neighbour", "step") and call in self._queue:
            return  # only the newest counts
        self._queue.append(call)
        while len(self._queue) > MAX_QUEUE or (call.size and sum(one.size for one in self._queue) > MAX_QUEUE_BYTES):
            # Not a timer, on which an app may have built its next one.
            lost = next((one for one in self._queue if one.handler in _FROM_OUTSIDE), self._queue[0])
            self._queue.remove(lost)
            self.counters["lost_events"] += 1
        self._next(now)

    def _next(self, now: float) -> None:
        """Call the next handler, where none runs. Before `start` has returned nothing else is called."""
        if self.running is not None or not self._queue:
            return
        if not self._began:
            start = HandlerCall("start")
            if start not in self._queue:
                return
            self._queue.remove(start)
            self.running = start
        else:
            self.running = self._queue.popleft()
        self._since = now
        self._actions.append(self.running)
