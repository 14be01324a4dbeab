"""The notes of robots about the membership of a run (`swarm.core.epochs`): records, votes, and their bytes."""

from collections import Counter
from dataclasses import dataclass
from hashlib import blake2b
from typing import Annotated

from swarm.core.graph import Edge, Graph
from swarm.core.lockstep.frames import MAX_ITERATION
from swarm.errors import PayloadError
from swarm.frozen import frozen
from swarm.messages.codec import MAX_COUNT, MAX_PAYLOAD, Between, decode, encode

MAX_NEIGHBOURS = 255
"""Most neighbours of a robot in an epoch: a snapshot of the lockstep counts them in one byte."""

MAX_EPOCH = (MAX_PAYLOAD - 6 * 1024) // 3
"""Bytes of a packed epoch that others have told: a note may hold three of them, and 255 names besides."""

LOST = 1 << 62
"""Numbers of lost votes are smaller."""

LostVote = Annotated[int, Between(1, LOST - 1)]
Count = Annotated[int, Between(0, MAX_COUNT)]
Number = Annotated[int, Between(0, (1 << 32) - 1)]
Iteration = Annotated[int, Between(0, MAX_ITERATION)]


@dataclass(frozen=True, slots=True, order=True)
class Ballot:
    """One attempt to agree; a later one goes before an earlier one. Round 0 is none at all."""

    round: Count
    robot: str
    """The robot that makes the ballot."""


NONE = Ballot(0, "")


@frozen
class Epoch:
    """A stretch of a run with the same members and links: agreed upon by a majority of the members of the one before,
    or ordered by the operator."""

    number: Number
    """Checksum (u32) of all that follows, by which frames of different epochs are distinguished."""
    counter: Count
    """The number of epochs before it."""
    proposer: str
    before: Number
    """Number of the epoch that it follows."""
    k: Iteration
    """The iteration at which it begins."""
    members: tuple[str, ...]
    """The names of the members, sorted."""
    carried: tuple[str, ...]
    """The members that go on from x(k) of the epoch before; the others come with a value of their own."""
    edges: tuple[Edge, ...]
    """Links among the members."""
    away: tuple[str, ...]
    """Robots that only the operator lets in again."""
    restored: tuple[LostVote, ...]
    """The numbers of lost votes (`EpochNote.lost`) of members: from this epoch on these robots vote again. Sorted."""
    forced: bool
    """Ordered by the operator without a majority."""

    @property
    def graph(self) -> Graph:
        """The members and their links: neighbours and weights follow from it."""
        return Graph(self.members, self.edges)

    def supersedes(self, other: "Epoch") -> bool:
        """Return whether robots of `other` leave it for this one. Where operators have made two of one counter, one of
        them has to win everywhere."""
        if self.counter == 0 or self.number == other.number:
            return False
        return (self.counter, self.number) > (other.counter, other.number)


def first(members: tuple[str, ...], edges: tuple[Edge, ...], number: int) -> Epoch:
    """Return the epoch that a run begins with: nobody has agreed on it, `number` stands for the links."""
    names = tuple(sorted(members))
    return Epoch(number, 0, "", 0, 0, names, (), edges, (), (), forced=False)


def following(
    before: Epoch,
    proposer: str,
    k: int,
    members: tuple[str, ...],
    carried: tuple[str, ...],
    edges: tuple[Edge, ...],
    away: tuple[str, ...],
    restored: tuple[int, ...],
    *,
    forced: bool,
) -> Epoch:
    """Return the epoch after `before`."""
    body = (before.counter + 1, proposer, before.number, k, members, carried, edges, away, restored, forced)
    return Epoch(_number(body), *body)


def _number(body: tuple[object, ...]) -> int:
    return int.from_bytes(blake2b(repr(body).encode(), digest_size=4).digest(), "little")


@frozen
class Vote:
    """A robot's vote for an epoch in one ballot."""

    ballot: Ballot
    epoch: Epoch


@frozen
class Offer:
    """A ballot of the robot that tells it: first asked for, then with the epoch it is about."""

    ballot: Ballot
    epoch: Epoch | None
    forced: bool


@frozen
class EpochNote:
    """What a robot tells of its epoch and its votes. Each note replaces the robot's earlier ones everywhere."""

    robot: str
    birth: Count
    """Goes up with every start of the process."""
    version: Count
    """Goes up with every note of a process."""
    epoch: Epoch
    """The epoch in which the robot is, or the newest that it has heard of."""
    k: Annotated[int, Between(-1, MAX_ITERATION)]
    """The robot's iteration, where it has stopped for a ballot; -1: it has no state in this epoch."""
    well: bool
    """False: its app is in fault, or it was told to leave."""
    deaf: tuple[str, ...]
    """Neighbours that it cannot hear."""
    promised: Ballot
    """The earliest ballot that the robot still takes part in."""
    accepted: Vote | None
    offer: Offer | None
    lost: Annotated[int, Between(0, LOST - 1)]
    """0; of a robot that has found the file with its votes damaged: a random number that it has drawn then."""

    @property
    def age(self) -> tuple[int, int]:
        """Later notes have a higher one."""
        return self.birth, self.version

    @property
    def in_order(self) -> bool:
        """Whether the epochs that it votes for and offers come right after its own."""
        later = (each.epoch for each in (self.accepted, self.offer) if each is not None and each.epoch is not None)
        mine = self.epoch
        return all((each.counter, each.before) == (mine.counter + 1, mine.number) for each in later)

    @property
    def members(self) -> set[str]:
        """Return all robots that are members of any epoch in this note."""
        return {name for epoch in self._epochs for name in epoch.members}

    @property
    def _epochs(self) -> list[Epoch]:
        """Return all epochs in this note."""
        holders = (self, self.accepted, self.offer)
        return [each.epoch for each in holders if each is not None and each.epoch is not None]

    def encode(self) -> bytes:
        return encode(self)

    @classmethod
    def decode(cls, data: bytes) -> "EpochNote":
        """Unpack; `PayloadError` says what is wrong with it."""
        note = decode(cls, data, "epoch note")
        for epoch in note._epochs:
            _check(epoch)
        return note


@frozen
class SavedEpochs:
    """The state that must outlive the process (and the runtime directory, for robots that reboot), so that no robot
    votes twice."""

    run: int
    schema: int
    note: EpochNote


def _check(epoch: Epoch) -> None:
    """Refuse an epoch that cannot be one."""
    members = set(epoch.members)
    whole = (
        members
        and epoch.members == tuple(sorted(members))
        and set(epoch.carried) <= members
        and all(edge[0] != edge[1] and members.issuperset(edge) for edge in epoch.edges)
        and len({frozenset(edge) for edge in epoch.edges}) == len(epoch.edges)
        and max(Counter(end for edge in epoch.edges for end in edge).values(), default=0) <= MAX_NEIGHBOURS
        and (epoch.counter == 0 or len(encode(epoch)) <= MAX_EPOCH)
    )
    body = (epoch.counter, epoch.proposer, epoch.before, epoch.k, epoch.members, epoch.carried, epoch.edges, epoch.away)
    if not whole or (epoch.counter > 0 and epoch.number != _number((*body, epoch.restored, epoch.forced))):
        raise PayloadError(f"epoch {epoch.counter} of {epoch.proposer or 'nobody'}: it contradicts itself")
