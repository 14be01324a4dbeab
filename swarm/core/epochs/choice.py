"""The epoch that a proposer offers, and the one that votes have decided: pure functions of the notes of robots."""

from collections.abc import Iterable, Mapping

from swarm.core.epochs.actions import EpochRequest
from swarm.core.epochs.notes import Epoch, EpochNote, Offer, Vote, following
from swarm.core.epochs.roster import Roster
from swarm.core.graph import Edge, Graph
from swarm.messages.codec import MAX_COUNT


def choose(
    offer: Offer,
    request: EpochRequest,
    notes: Mapping[str, EpochNote],
    roster: Roster,
    wanted: Iterable[Edge],
    now: float,
) -> Epoch | None:
    """Return the epoch to offer: what may have been decided already, else what the proposer would have.

    `notes` are those of the members that have answered the ballot, `wanted` are the links of the topology in force.
    None: too few have answered, or there can be no further epoch.
    """
    epoch = roster.mine.epoch
    members = epoch.members
    if not offer.forced:
        if 2 * len(notes) <= len(members):
            return None
        votes = [note.accepted for note in notes.values() if note.accepted is not None]
        if votes:
            return max(votes, key=lambda vote: vote.ballot).epoch
    away = tuple(sorted((set(epoch.away) | set(request.drop)) - set(request.add)))
    there = {**notes, **roster.newcomers(now, *request.add)}
    there = {n: note for n, note in there.items() if note.well and n not in away and roster.is_there(n, now)}
    deaf = {frozenset((n, other)) for n, note in there.items() for other in note.deaf}
    pairs = {(min(edge), max(edge)) for edge in wanted}
    edges = sorted((a, b) for a, b in pairs if a != b and {a, b} <= there.keys() and frozenset((a, b)) not in deaf)
    parts = Graph(tuple(sorted(there)), edges).components()
    largest = max(parts, key=lambda part: (len(set(part) & set(members)), roster.me in part), default=())
    chosen = tuple(sorted(largest))
    if epoch.counter == MAX_COUNT:
        return None
    if not chosen or (not offer.forced and 2 * len(set(chosen) & set(members)) <= len(members)):
        return None
    carried = tuple(n for n in chosen if n in notes and notes[n].k >= 0)
    k = min((notes[n].k for n in carried), default=epoch.k)
    links = tuple(edge for edge in edges if edge[0] in chosen)
    restored = tuple(sorted({there[n].lost for n in chosen if there[n].lost}))
    return following(epoch, roster.me, k, chosen, carried, links, away, restored, forced=offer.forced)


def decided(epoch: Epoch, notes: Mapping[str, EpochNote]) -> Epoch | None:
    """Return the successor of `epoch` that has votes enough, None where none has; `notes` are its members'."""
    voters: dict[Vote, set[str]] = {}
    for name, note in notes.items():
        if note.accepted is not None:
            voters.setdefault(note.accepted, set()).add(name)
    for vote, names in voters.items():
        majority = 2 * len(names) > len(epoch.members)
        enough = names >= set(vote.epoch.carried) if vote.epoch.forced else majority
        if enough:
            return vote.epoch
    return None
