"""The newest notes of a run's other robots, and when they came."""

from swarm.core.epochs.notes import Ballot, EpochNote

FRESH = 3.5
"""A robot is there if its newest note is at most so old, s."""


class Roster:
    """The notes, the own one among them."""

    def __init__(self, me: str, mine: EpochNote) -> None:
        self.me = me
        self.mine = mine
        self.notes: dict[str, EpochNote] = {}
        """The notes of the other robots."""
        self.heard: dict[str, float] = {}
        """The times at which the notes came."""

    def take(self, note: EpochNote, now: float) -> None:
        """Keep a newer note of another robot."""
        self.notes[note.robot] = note
        self.heard[note.robot] = now

    def is_there(self, name: str, now: float) -> bool:
        """Return whether a robot was heard of lately."""
        return name == self.me or now - self.heard.get(name, float("-inf")) <= FRESH

    def of_members(self) -> dict[str, EpochNote]:
        """Return the notes of members who know of this epoch, the own one too."""
        return {
            name: note
            for name, note in ((n, self.mine if n == self.me else self.notes.get(n)) for n in self.mine.epoch.members)
            if note is not None and note.epoch.number == self.mine.epoch.number
        }

    def answered(self, ballot: Ballot) -> dict[str, EpochNote]:
        """Return the notes of members who take part in a ballot."""
        return {name: note for name, note in self.of_members().items() if note.promised == ballot}

    def newcomers(self, now: float, *added: str) -> dict[str, EpochNote]:
        """Return the robots that are there and know that they have no part in this epoch, or that have lost their vote;
        `added`: whom the operator lets in."""
        away = set(self.mine.epoch.away) - set(added)
        return {
            name: note
            for name, note in self.notes.items()
            if note.well and name not in away and self.is_there(name, now) and (note.lost or self._outside(note))
        }

    def waited_for(self, now: float) -> bool:
        """Return whether there are robots that a further epoch would take in or give their vote back. A member that has
        lost its vote and goes on without it is no reason to stop where the others are too few to decide."""
        members = self.mine.epoch.members
        lost = sum(1 for name in members if name in self.notes and self.notes[name].lost)
        enough = 2 * (len(members) - lost) > len(members)
        return any(enough or self._outside(note) for note in self.newcomers(now).values())

    def _outside(self, note: EpochNote) -> bool:
        """Return whether a robot is in no epoch, or in one of its own. Who has not heard of this one yet will: no
        matter."""
        if note.epoch.number == self.mine.epoch.number:
            return note.robot not in self.mine.epoch.members
        return not note.epoch.supersedes(self.mine.epoch) and not self.mine.epoch.supersedes(note.epoch)

    def orphaned(self, now: float) -> bool:
        """Return whether the ballot under way has lost its proposer: another one has to end what it began."""
        mine = self.mine
        newest = max(self.of_members().values(), key=lambda note: note.promised)
        by = newest.promised.robot
        if by == self.me:
            return mine.offer is None
        proposer = self.notes.get(by)
        return not (
            self.is_there(by, now)
            and proposer is not None
            and proposer.well
            and proposer.offer is not None
            and proposer.offer.ballot >= newest.promised
        )
