"""The membership of a run: an agreed change of its members and links, at an agreed iteration, without a leader.

The members of an epoch agree on the next one as in Paxos (Lamport, The Part-Time Parliament, 1998), one decision an
epoch. A robot that wants a change makes a ballot. Members that hear of it promise to take part in no earlier one,
**stop where they are**, and say at which iteration that is. When a majority has answered, the proposer offers an epoch:
those who answered and who join, their links, and K, the smallest of the iterations told. A majority that accepts it has
decided, and every robot finds that out by itself. All go on from x(K) of the old epoch, which every one of them has or
has had: neighbours are at most one iteration apart, so nobody goes back by more than the graph's diameter.

- Two majorities of the same members have a robot in common, and it keeps its word through kills and reboots
  (`SaveEpochs` comes before `SendToNeighbours`): of two halves at most one ever goes on; each epoch has one successor.
- Who has promised does not compute on before there is a decision: K stays within what all can go back to.
- Robots that left, that lost their state in a reboot, or that come late are heard of by their notes, and are taken in
  by the next epoch, with a value of their own.
- A robot whose file of votes is damaged may have voted for anything. It draws a random number and says so. Until an
  epoch names that number it votes for nothing and enters no epoch but the one that its snapshots are of: an epoch that
  names it was chosen after the loss, so the robot cannot have voted in it before.
- The operator may request a change; with `force` it is made by those who answer, be they a minority.

What a robot has to say is one note, newer ones replace older ones, and notes are passed on by everybody who had not
seen them: over any number of hops, without routes. In an epoch that nobody wants to change nobody says anything.

The core is pure: notes and `now` go in, `actions()` come out, to be carried out in that order. The host keeps `k` at
the lockstep's iteration; it is -1 where the state of this epoch is lost. `stalled` says that it does not get on: then
the neighbours are to hear that this robot is there, and that it is not the one that all wait for.
"""

from collections import Counter
from collections.abc import Iterable
from dataclasses import replace

from swarm.core.epochs.actions import Action, EpochRequest, SaveEpochs, SendToNeighbours, SwitchEpoch
from swarm.core.epochs.choice import choose, decided
from swarm.core.epochs.notes import NONE, Ballot, Epoch, EpochNote, Offer, SavedEpochs, Vote
from swarm.core.epochs.roster import Roster
from swarm.core.graph import Edge
from swarm.errors import PayloadError
from swarm.messages.codec import MAX_COUNT

COLLECT = 1.0
"""Seconds for which a ballot waits for answers of members who may be slow, and ..."""
QUIET = 0.4
"""... s since the last one: after a partition many come at once, and all of them shall be in."""
TELL_EVERY = 1.0
"""Seconds between two notes of a robot that wants something."""
TELL_AGAIN = 0.2
"""Seconds between two notes to robots that seem not to know."""
MAX_FOUND = 1 << 62
"""A robot goes on counting its starts from a greater count that others have heard of, up to this: above it there is
room for the starts to come."""
STAGGER = 0.3
"""Seconds by which each member waits longer than the one before it to make a ballot: mostly one of them does."""


class Epochs:
    """The membership of one run, as one robot knows it."""

    def __init__(
        self,
        me: str,
        names: Iterable[str],
        of: tuple[int, int],
        birth: int,
        begin: Epoch,
        kept: SavedEpochs | None,
        *,
        auto: bool,
        lost: int = 0,
    ) -> None:
        """`names`: all robots there may be. `of`: run and schema. `begin`: the epoch of a run of which nothing was
        `kept`. `auto`: make ballots when robots are lost, come (back) or links change; otherwise only when ordered.
        `lost`: where what was kept is damaged, a random number, 1 to 2^62 - 1."""
        self.me = me
        self.auto = auto
        self.counters: Counter[str] = Counter()
        self.well = True
        self.stalled = False
        self._names = frozenset(names)
        self._of = of
        known = kept is not None and (kept.run, kept.schema) == of
        self.new = not known and not lost
        """Whether this robot has not been in the run yet, so that it begins with the app's first state."""
        if kept is not None and known:
            mine = replace(kept.note, birth=max(birth, kept.note.birth + 1), version=0, offer=None, well=True)
        else:
            mine = EpochNote(me, birth, 0, begin, -1, True, (), NONE, None, None, lost)
        self._roster = Roster(me, mine)
        self._mine = mine
        self._become()
        self.k = mine.epoch.k
        self._edges = begin.edges
        self._bound: tuple[object, ...] = ()
        self._relink = False
        self._settled = self.new  # the host of another one has to say first where that is, or that it has no state
        self.deaf: tuple[str, ...] = ()
        """The neighbours that it was told cannot be heard."""
        self._request: EpochRequest | None = None
        self._round = self._mine.promised.round
        self._offered_at = self._answered_at = 0.0
        self._answers: frozenset[str] = frozenset()
        self._tell_at = self._told_at = self._reminded_at = float("-inf")
        self._cause_at: float | None = None
        self._actions: list[Action] = []

    # What the host asks

    @property
    def epoch(self) -> Epoch:
        """The newest epoch known."""
        return self._mine.epoch

    @property
    def birth(self) -> int:
        """Return the birth number of this process, higher than that of any earlier process on this robot."""
        return self._mine.birth

    @property
    def kept(self) -> SavedEpochs:
        """Return the data that must outlive the process."""
        return SavedEpochs(*self._of, self._mine)

    @property
    def lost(self) -> bool:
        """Whether this robot has lost its vote, and no epoch has given it another."""
        return self._mine.lost != 0

    @property
    def reason(self) -> str:
        """Why it does not go on, as far as that is a matter of membership; else empty."""
        if self.lost and self.k < 0:
            return f"{self.me} has lost its vote and waits for the next epoch"
        if not self.member:
            how = "only the operator lets it in again" if self.me in self.epoch.away else "waits to be let in"
            return f"{self.me} is not in epoch {self.epoch.counter}: {how}"
        if self._mine.promised == NONE:
            return ""
        answers, members = len(self._roster.answered(self._mine.promised)), len(self.epoch.members)
        return f"the members change: {answers} of {members} have answered, more than half are needed"

    def actions(self) -> list[Action]:
        """Return the actions to be done now, in this order."""
        actions, self._actions = self._actions, []
        return actions

    def next_deadline(self, now: float) -> float | None:
        """Return the time at which the host must call `handle_timer`; None while no timer runs."""
        if not (self.auto or self.frozen or self.k < 0 or self._request is not None or self._offers or self._mine.lost):
            return None  # asked after each message, and nearly always so
        times = [self._tell_at] if self._busy else []
        if self._mine.offer is not None and self._mine.offer.epoch is None and now < self._collected_at:
            times.append(self._collected_at)
        if self._cause(now):
            times.append(now if self._cause_at is None else self._cause_at)
        return min(times, default=None)

    # What the host tells

    def take_links(self, edges: tuple[Edge, ...]) -> None:
        """Take the links of the topology in force."""
        if edges != self._edges:
            self._edges = edges
            members = set(self.epoch.members)
            here = {frozenset(edge) for edge in edges if members.issuperset(edge)}
            self._relink = here != {frozenset(edge) for edge in self.epoch.edges}

    def settle(self) -> None:
        """The host is in the newest epoch, at `k`: only now is there a state to make promises with."""
        self._settled = True

    def resettle(self) -> None:
        """The host's state is of an earlier epoch: it has not done yet what the last `SwitchEpoch` asked for."""
        self._settled = False
        self._actions.append(SwitchEpoch(self.epoch))

    def lose(self) -> None:
        """The state of this epoch is gone, whatever was told of it."""
        self.k, self._settled = -1, True
        self._become(k=-1)

    def suspect(self, names: tuple[str, ...], now: float) -> None:
        """Take the sorted names of the neighbours that cannot be heard."""
        if names != self.deaf:
            self.deaf = names
            if self._mine.promised != NONE:
                self._tell(now)

    def withdraw(self, now: float) -> None:
        """This robot takes no part, be it for a fault or for the time being: the others need not wait for it."""
        self.well = False
        self._become(offer=None)
        if self.auto:
            self._tell(now)

    def take_part(self, now: float) -> None:
        """This robot can take part from now on. The others hear of it at once where the host has said where it is."""
        self.well = True
        if self._settled:
            self._tell(now)

    def request(self, request: EpochRequest, now: float) -> None:
        """The operator asks for other members."""
        self._request = request
        self._propose(now)

    def stranger(self, now: float) -> None:
        """Somebody sends frames of another epoch: one of us does not know the newest one."""
        if now >= self._told_at + TELL_AGAIN:
            self._tell(now)

    def receive(self, data: bytes, now: float) -> None:
        """Take a note of any robot."""
        try:
            note = EpochNote.decode(data)
        except PayloadError:
            self.counters["malformed note"] += 1
            return
        if note.robot not in self._names or not note.members <= self._names:
            self.counters["unknown robot"] += 1
            return
        if not note.in_order:
            self.counters["vote out of order"] += 1
            return
        if note.robot == self.me:
            if note.birth >= MAX_FOUND:
                self.counters["impossible birth"] += 1
            elif note.age > self._mine.age:  # of a process whose files are lost: the others listen to it alone
                self._become(birth=note.birth + 1, version=0)
                self._tell(now)
            return
        known = self._roster.notes.get(note.robot)
        if known is not None and note.age <= known.age:
            other = note.birth < known.birth or (note.birth == known.birth and note.lost != known.lost)
            if other and now >= self._reminded_at + TELL_AGAIN:
                # It lost its files, and does not know that it has to count on from there.
                self._reminded_at = now
                self._actions.append(SendToNeighbours(known.encode()))
            return
        self._roster.take(note, now)
        self._actions.append(SendToNeighbours(data))  # who has it passes it on no more
        self._weigh(note, now)

    def handle_timer(self, now: float) -> None:
        """Do what is due."""
        self._drive(now)
        if not self._cause(now):
            self._cause_at = None
        elif self._cause_at is None:
            self._cause_at = now + STAGGER * self.epoch.members.index(self.me)
        if self._cause_at is not None and now >= self._cause_at:
            self._cause_at = None
            self._propose(now)
        if self._busy and now >= self._tell_at:
            self._tell(now)

    # How it works

    def _become(self, **changes: object) -> None:
        """Have something else to say. What is asked with each frame is worked out here."""
        self._mine = self._roster.mine = mine = replace(self._mine, **changes)  # type: ignore[arg-type]
        self.number = mine.epoch.number
        """The number of the newest epoch known."""
        self.member = self.me in mine.epoch.members
        """Whether this robot is in it."""
        self.frozen = mine.promised != NONE or not self.member
        """Whether the robot must not compute, because it has answered a ballot or is no member of the epoch."""
        self._offers = mine.offer is not None

    @property
    def _busy(self) -> bool:
        """Whether this robot wants something of the others."""
        wanting = not self.well or self.deaf or self.stalled
        return self.frozen or self.lost or self.k < 0 or self._request is not None or bool(self.auto and wanting)

    @property
    def _collected_at(self) -> float:
        """Return the time after which a ballot need not wait for further answers."""
        return max(self._offered_at + COLLECT, self._answered_at + QUIET)

    def _weigh(self, note: EpochNote, now: float) -> None:
        if note.epoch.supersedes(self.epoch):
            self._adopt(note.epoch, now)
        elif note.epoch.number != self.epoch.number:
            if self.epoch.supersedes(note.epoch):
                self.stranger(now)
            return
        elif note.offer is not None and self.member and self._settled:
            self._answer(note.offer, now)
        self._round = max(self._round, note.promised.round)
        self._drive(now)
        self._decide(now)

    def _answer(self, offer: Offer, now: float) -> None:
        """Promise or accept, as an acceptor. A robot without a vote answers only offers that an operator has forced."""
        mine = self._mine
        if mine.lost and not offer.forced:
            return
        if offer.epoch is None:
            if offer.ballot > mine.promised:
                self._stop(offer.ballot, mine.accepted, now)
        elif offer.ballot >= mine.promised and (mine.accepted is None or mine.accepted.ballot < offer.ballot):
            self._stop(offer.ballot, Vote(offer.ballot, offer.epoch), now)

    def _stop(self, promised: Ballot, accepted: Vote | None, now: float) -> None:
        """Compute no more, and say where: first of all promises fixes the iteration, it does not move any more."""
        k = self.k if self._mine.promised == NONE else self._mine.k
        offer = self._mine.offer
        if offer is not None and offer.ballot < promised:
            offer = None
        self._become(promised=promised, accepted=accepted, offer=offer, k=k)
        self._tell(now)

    @property
    def _forced(self) -> bool:
        """Whether the operator has ordered a change without a majority."""
        return self._request is not None and self._request.force

    @property
    def _may_propose(self) -> bool:
        """Whether this robot can make a ballot: a member with a state and its votes, or one that a request forces.

        Above the greatest round there is nothing; only a liar has named it (docs/reference/network/captured-member.md).
        """
        if not self.member or not self.well or not self._settled or self._round == MAX_COUNT:
            return False
        return not self.lost or self._forced

    def _propose(self, now: float) -> None:
        if not self._may_propose:
            return
        self._round += 1
        ballot = Ballot(self._round, self.me)
        self._become(offer=Offer(ballot, None, self._forced))
        self._offered_at = self._answered_at = now
        self._stop(ballot, self._mine.accepted, now)
        self._drive(now)
        self._decide(now)

    def _drive(self, now: float) -> None:
        """Go on with an own ballot, as its proposer, where enough robots have answered."""
        offer = self._mine.offer
        if offer is None or offer.epoch is not None:
            return
        notes = self._roster.answered(offer.ballot)
        if frozenset(notes) != self._answers:
            self._answers, self._answered_at = frozenset(notes), now
        complete = len(notes) == len(self.epoch.members) and not self._roster.newcomers(now)
        if not complete and now < self._collected_at:
            return
        epoch = choose(offer, self._request or EpochRequest(), notes, self._roster, self._edges, now)
        if epoch is not None:
            self._become(offer=replace(offer, epoch=epoch))
            self._stop(offer.ballot, Vote(offer.ballot, epoch), now)

    def _decide(self, now: float) -> None:
        """Adopt an epoch that has enough votes; every robot checks this."""
        epoch = decided(self.epoch, self._roster.of_members())
        if epoch is not None:
            self._adopt(epoch, now)

    def _adopt(self, epoch: Epoch, now: float) -> None:
        lost = 0 if self._mine.lost in epoch.restored else self._mine.lost
        self._become(epoch=epoch, promised=NONE, accepted=None, offer=None, lost=lost)
        self.k = -1 if lost else epoch.k
        self._settled = bool(lost)
        if self._request is None or not set(self._request.drop) & set(epoch.members) or not self.member:
            self._request = None
        self._relink = False
        self.deaf = ()
        self._cause_at = None
        self._tell(now)
        if not lost:  # else it may have been in this epoch, and must not begin it a second time
            self._actions.append(SwitchEpoch(epoch))

    def _cause(self, now: float) -> bool:
        """Return whether this robot should make a ballot."""
        mine = self._mine
        if not self._may_propose:
            return False
        if mine.promised != NONE:
            return self._roster.orphaned(now)
        if self._request is not None or (self.auto and (self.deaf or self._relink)):
            return True
        if not self.auto or not self._roster.notes:
            return False
        members = self._roster.of_members()
        lost = any(not note.well or note.k < 0 for name, note in members.items() if name != self.me)
        return lost or self._roster.waited_for(now)

    def _tell(self, now: float) -> None:
        mine = self._mine
        k = mine.k if mine.promised != NONE else self.k
        self._become(version=mine.version + 1, well=self.well, deaf=self.deaf, k=k)
        self._told_at, self._tell_at = now, now + TELL_EVERY
        new = self._mine
        stopped_at = new.k if new.promised != NONE else None
        bound = (new.birth, new.epoch, new.promised, new.accepted, new.lost, stopped_at)
        if bound != self._bound:  # a repetition binds to nothing new: it need not wait for a disk
            self._bound = bound
            self._actions.append(SaveEpochs(self.kept))
        self._actions.append(SendToNeighbours(new.encode()))
