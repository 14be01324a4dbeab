"""A lockstep of an app on one robot: the author's steps, the lockstep core, its epochs, and the rule for its end.

An app has one, or one for each of its channels. It has no IO, no clock and no thread: the driver
(`services.apps.host.lockstep_driver`) has these. Two things happen to it, perhaps in two threads: messages and timers,
which take no time, and the app's code, which may take long or never return. So `start`, `compute` and `renew` alone run
the author's code, all that belongs to one iteration together, beside whatever else happens.
"""

import struct
from collections import deque
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from services.apps.core.terms import AppAnswer, Program, Terms, Told
from swarm.core.epochs import actions as epoch_actions
from swarm.core.epochs.actions import EpochRequest, SaveEpochs, SwitchEpoch
from swarm.core.epochs.epochs import Epochs
from swarm.core.epochs.notes import Epoch, SavedEpochs
from swarm.core.epochs.roster import FRESH
from swarm.core.graph import Graph
from swarm.core.lockstep import actions as lockstep_actions
from swarm.core.lockstep.actions import Compute, Fault, Finished, Save, Waiting
from swarm.core.lockstep.frames import Channel, Snapshot
from swarm.core.lockstep.lockstep import RTT, Lockstep
from swarm.core.lockstep.stopping import Stopping
from swarm.frozen import frozen
from swarm.messages import Measurement

ALONE = 0.03
"""Seconds of an iteration of a robot without neighbours, which waits for no other robot."""

_STAMP = struct.Struct("<dd")  # before the private fields in a snapshot: when its state was computed, and the first one


@frozen
class Renew:
    """Let the app go over to the newest epoch (`LockstepRun.renew`), when no step runs."""

    epoch: Epoch


class RunState(NamedTuple):
    """The app's state at one iteration."""

    k: int
    own: bytes
    private: bytes
    at: float


Action = lockstep_actions.Action | epoch_actions.Action | Renew


class LockstepRun:
    """One lockstep of an app, without input and output; the module's text describes its two sides."""

    def __init__(
        self,
        me: str,
        names: frozenset[str],
        terms: Terms,
        begin: Epoch,
        graph: Graph,
        incarnation: int,
        program: Program,
        kept: SavedEpochs | None = None,
        vote_lost: int = 0,
    ) -> None:
        """`names`: all robots there may be; `begin`: the epoch of a run of which nothing was `kept`; `graph`: its
        links. Of thousands of robots in one process, all may be given the same ones. `vote_lost`: a random number where
        what was kept is damaged."""
        self.phase = "starting"
        """starting, running, done or fault."""
        self.reason = ""
        """The reason of a fault, or what is amiss with a run that is done."""
        self.waiting: tuple[str, ...] = ()
        """Robots whose value has been missing for a while."""
        self.computed_at = 0.0
        """The time at which the newest state was computed."""
        self.told: Told | None = None
        """What the app tells of the newest state; None before the first one."""
        self.lost = False
        """Whether this robot was in the run and has lost its state, as after a reboot."""
        of = terms.run, terms.schema
        self.epochs = Epochs(me, names, of, incarnation, begin, kept, auto=terms.drop, lost=vote_lost)
        self.rtt = RTT
        self._me = me
        self.terms = terms
        self._program = program
        self._stopping: Stopping | None = None
        self._lockstep: Lockstep | None = None
        self.channel = self._channel_of(self.epochs.epoch)
        """The channel under which the frames travel."""
        self._graph = graph if self.epochs.number == begin.number else self.epochs.epoch.graph
        self._history: deque[RunState] = deque()
        self._began_at = 0.0
        self.progress_at = 0.0
        """The time at which it began, computed a state or came to another epoch last."""
        self._heard: dict[str, float] = {}
        """The times at which neighbours were heard last, where those that are not heard are given up."""
        self._first_save = True

    @property
    def k(self) -> int:
        """The iteration it is at."""
        return self._history[-1].k if self._history else 0

    @property
    def begun(self) -> bool:
        """Whether there is a first state."""
        return self._lockstep is not None

    @property
    def counters(self) -> Mapping[str, int]:
        """Return the counters of dropped and requested frames."""
        return {**self.epochs.counters, **(self._lockstep.counters if self._lockstep is not None else {})}

    @property
    def obstacle(self) -> str:
        """Why it does not go on, as far as membership is the reason; else empty."""
        if self.lost and self.epochs.member:
            return f"{self._me} has lost its state and waits for the next epoch"
        return self.epochs.reason

    # The app's side

    def saved(self, pages: Sequence[bytes]) -> list[Snapshot]:
        """Return the snapshots that an earlier process of this run and version has left, from the oldest to the
        newest, as `pages` are."""
        found = [Snapshot.decode(page) for page in pages]
        return [one for one in found if (one.run, one.schema) == (self.terms.run, self.terms.schema)]

    def start(self, saved: Sequence[Snapshot], measurement: Measurement | None) -> AppAnswer | None:
        """Let the app be where the newest snapshot was taken, or set its first state where this robot is new; what it
        gives goes to `begin`. None: it goes on with the next epoch."""
        if not saved:
            return self._answer(*self._program.start(measurement)) if self.epochs.new else None
        if not self._resumes(saved[-1]):
            return None
        own, private = saved[-1].value[: self._program.size], saved[-1].private[_STAMP.size :]
        self._program.restore(saved[-1].k, own, private, self._graph)
        return self._answer(own, private)

    def begin(self, saved: Sequence[Snapshot], first: AppAnswer | None, now: float) -> None:
        """Go on from snapshots, the newest last, or begin with the app's first state; `first` is what `start` gave."""
        self.phase = "running"
        self.progress_at = self._began_at = now
        if saved:
            self._history = deque(maxlen=len(saved))
            for snapshot in saved:
                if snapshot.epoch == saved[-1].epoch:
                    computed_at, self._began_at = _STAMP.unpack_from(snapshot.private)
                    private = snapshot.private[_STAMP.size :]
                    self._history.append(RunState(snapshot.k, snapshot.value, private, computed_at))
            self.channel = Channel(self.terms.run, saved[-1].epoch, self.epochs.birth, self.terms.schema)
        elif first is not None:
            self._history.append(RunState(0, first.own, first.private, now))
        else:
            self.lost = True
        if first is not None and not self._changing:
            if saved:
                self._resume(saved[-1], first.told, self.epochs.epoch, now)
            else:
                self._enter(self.epochs.epoch, first, now)
            self.epochs.settle()
        elif self._changing and not self.epochs.lost:
            self.epochs.resettle()  # to an epoch that has come after this state, perhaps while `start` ran
        else:
            self.epochs.lose()

    def compute(self, todo: Compute, measurement: Measurement | None) -> AppAnswer:
        """Run the app's step; what it gives goes to `computed`."""
        size = self._program.size  # behind it stands the count of a rule to stop
        values = {name: value[:size] for name, value in todo.values.items()}
        own, private = self._program.step(todo.k, todo.own[:size], values, measurement)
        content = self.terms.rule is not None and self._program.content()
        return AppAnswer(own, private, self._program.told(), content)

    def renew(self, epoch: Epoch, measurement: Measurement | None) -> AppAnswer | None:
        """Let the app go over to an epoch; what it gives goes to `renewed`. None: this robot has no part in it."""
        if self._me not in epoch.members:
            return None
        self._graph = epoch.graph
        state = self._before(epoch)
        if state is not None:
            at, own, private = state.k, state.own, state.private
        else:
            at, (own, private) = 0, self._program.start(measurement)
        return self._answer(*self._program.renew(epoch.k, at, own, private, self._graph))

    # The other side

    def computed(self, todo: Compute, answer: AppAnswer, now: float) -> None:
        """Go on with what `compute` gave."""
        core = self._lockstep
        if core is None or self.epochs.frozen or self._changing or core.fault is not None:
            return
        own, private, self.told, content = answer
        last = False
        if self._stopping is not None:
            size = self._program.size
            counts = [value[size:] for value in todo.values.values()]
            seconds = now - self._began_at
            count = self._stopping.next(todo.own[size:], counts, content=content, seconds=seconds)
            own += count
            last = self._stopping.over(count)
        self.progress_at = self.computed_at = now
        self._history.append(RunState(todo.k + 1, own, private, now))
        core.computed(own, self._stamp(private), now, last=last)
        self.epochs.k = core.k

    def renewed(self, epoch: Epoch, answer: AppAnswer | None, now: float) -> None:
        """Go on with what `renew` gave."""
        if epoch.number != self.epochs.number:
            return  # there is a newer one by now
        if answer is not None:
            self._enter(epoch, answer, now)
        self.epochs.settle()

    def receive(self, sender: str, channel: Channel, payload: bytes, now: float, *, around: bool = False) -> None:
        """Take a frame; `around`: it came over other robots, not over the link with its sender. Before the own start
        a frame is dropped, and its sender is asked again later."""
        core = self._lockstep
        if self.terms.drop:
            self._heard[sender] = now
        if channel.epoch != self.epochs.number and sender != self._me:
            self.epochs.stranger(now)
        if core is not None and not self._changing:
            core.receive(sender, channel, payload, now, around=around)

    def receive_note(self, sender: str, payload: bytes, now: float) -> None:
        """Take a robot's note about the membership, passed on by `sender`."""
        if self.terms.drop:
            self._heard[sender] = now
        self.epochs.receive(payload, now)

    def request(self, request: EpochRequest, now: float) -> None:
        """The operator asks for other members."""
        self.epochs.request(request, now)

    def nudge(self, now: float) -> None:
        """The bus or a link came up: ask now for what is missing."""
        if self._lockstep is not None and not self._changing:
            self._lockstep.nudge(now)
            self._lockstep.handle_timer(now)

    def handle_timer(self, now: float) -> None:
        """Do what is due."""
        if self.phase == "starting" and self.epochs.well:
            return
        if self._lockstep is not None and not self._changing:
            self._lockstep.rtt = self.rtt
            self._lockstep.handle_timer(now)
        if self.terms.drop:
            awaited = self._awaited()
            self.epochs.stalled = bool(awaited) and now >= self._stalled_at
            silent = {n for n, at in awaited if now >= at}
            quiet = min(self.terms.after, FRESH)
            silent |= {n for n in self.epochs.deaf if now - self._heard.get(n, float("-inf")) > quiet}
            self.epochs.suspect(tuple(sorted(silent)), now)
        self.epochs.handle_timer(now)

    def next_deadline(self, now: float) -> float | None:
        """Return the time at which the driver must call `handle_timer`."""
        if self.phase == "starting" and self.epochs.well:
            return None
        # After each message: without lists and generators where nothing is about the members.
        earliest = self.epochs.next_deadline(now)
        if self._lockstep is not None and not self._changing:
            deadline = self._lockstep.next_deadline()
            if earliest is None or (deadline is not None and deadline < earliest):
                earliest = deadline
        if self.terms.drop:
            times = [at for _, at in self._awaited() if at > now]
            if self._stalled_at > now:
                times.append(self._stalled_at)
            if earliest is not None:
                times.append(earliest)
            return min(times, default=None)
        return earliest

    def actions(self) -> list[Action]:
        """Return the actions of the driver, in this order. Advanced, Fault, Finished, Waiting and SwitchEpoch are
        reports."""
        found: list[Action] = []
        for action in self._lockstep.actions() if self._lockstep is not None else ():
            # Of each iteration, so by the very type: a match takes three times as long.
            if type(action) is Compute:
                if self.epochs.frozen or self._changing:
                    continue
            elif type(action) is Waiting:
                self.waiting = action.peers
            elif type(action) is Fault:
                self.fail(action.reason, self.progress_at)
            elif type(action) is Finished and self.phase != "fault":
                self.phase = "done"
                if self._stopping is not None:
                    self.reason = self._stopping.unmet(self.k, self._history[-1].own[self._program.size :])
            found.append(action)
            if type(action) is Save and self._first_save:
                # Not before there is a state: a robot of which this is all there is knows that it has lost its own.
                self._first_save = False
                found.append(SaveEpochs(self.epochs.kept))
        for news in self.epochs.actions():
            if not isinstance(news, SwitchEpoch):
                found.append(news)
            elif self.phase != "starting":  # else there is no state yet to go over with: `begin` asks for it again
                found += (news, Renew(news.epoch))
        return found

    def fail(self, reason: str, now: float) -> bool:
        """Compute no more; neighbours still get answers, and the reason can be read. Whether that is news."""
        if self.phase == "fault":
            return False
        self.phase, self.reason = "fault", reason
        self.epochs.withdraw(now)
        return True

    # How it works

    @property
    def _changing(self) -> bool:
        """Whether the lockstep is of an epoch that is over."""
        return self.channel.epoch != self.epochs.number

    @property
    def _stalled_at(self) -> float:
        """Return the time at which the others shall hear that this robot is stalled."""
        return self.progress_at + self.terms.after / 2

    def _awaited(self) -> list[tuple[str, float]]:
        """Neighbours that this robot waits for, and when they are to be given up, sorted."""
        if self._lockstep is None or self._changing or self.phase != "running":
            return []
        waiting, after = self._lockstep.waiting_for, self.terms.after
        if self.epochs.frozen and self.epochs.member:
            # A robot that has stopped for a ballot waits for all neighbours. They repeat their notes once a second.
            waiting, after = self._graph.neighbours(self._me), max(after, FRESH)
        return [(n, max(self.progress_at, self._heard.get(n, 0.0)) + after) for n in waiting]

    def _answer(self, own: bytes, private: bytes) -> AppAnswer:
        return AppAnswer(own, private, self._program.told())

    def _resumes(self, snapshot: Snapshot) -> bool:
        """Return whether this robot goes on in the epoch of a snapshot."""
        return snapshot.epoch == self.epochs.number and self.epochs.member

    def _channel_of(self, epoch: Epoch) -> Channel:
        return Channel(self.terms.run, epoch.number, self.epochs.birth, self.terms.schema)

    def _before(self, epoch: Epoch) -> RunState | None:
        """Return the state with which this robot goes over to an epoch: that of its first iteration, or the newest
        one."""
        if self._me in epoch.carried and self.channel.epoch == epoch.before:
            for state in self._history:
                if state.k == epoch.k:
                    return self._plain(state)
        return self._plain(self._history[-1]) if self._history else None

    def _plain(self, state: RunState) -> RunState:
        return state._replace(own=state.own[: self._program.size])

    def _lockstep_of(self, epoch: Epoch) -> Lockstep:
        rule = self.terms.rule
        self._stopping = Stopping(rule, self._graph) if rule is not None else None
        self.channel = self._channel_of(epoch)
        size = self._program.size + (Stopping.size if self._stopping is not None else 0)
        neighbours = self._graph.neighbours(self._me)
        # An epoch may begin behind the last iteration where a robot has told a wrong one: there is nothing left to do.
        last = None if self.terms.last is None else max(self.terms.last, epoch.k)
        return Lockstep(self._me, neighbours, self.channel, size, last=last, rtt=self.rtt)

    def _enter(self, epoch: Epoch, first: AppAnswer, now: float) -> None:
        self._lockstep = self._lockstep_of(epoch)
        own, private, self.told, _ = first
        own += Stopping.first() if self._stopping is not None else b""
        self.progress_at = self.computed_at = now
        self._heard.clear()
        # So far back the slowest robot of the epoch can be.
        self._history = deque([RunState(epoch.k, own, private, now)], maxlen=self._graph.span + 2)
        self.lost = False
        self.waiting = ()
        if self.phase == "done":
            self.phase, self.reason = "running", ""
        self._program.entered(epoch.k)
        self._lockstep.start(own, now, self._stamp(private), epoch.k)
        self.epochs.k = epoch.k

    def _resume(self, snapshot: Snapshot, told: Told, epoch: Epoch, now: float) -> None:
        """Go on in the epoch of an earlier process."""
        self._lockstep = self._lockstep_of(epoch)
        state = self._history[-1]
        count = state.own[self._program.size :]
        self._lockstep.resume(snapshot.encode(), now, last=self._stopping is not None and self._stopping.over(count))
        self._history = deque(self._history, maxlen=self._graph.span + 2)
        self.computed_at, self.told = state.at, told
        self.epochs.k = state.k

    def _stamp(self, private: bytes) -> bytes:
        return _STAMP.pack(self.computed_at, self._began_at) + private
