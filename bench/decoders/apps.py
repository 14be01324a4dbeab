"""The decoders of locksteps, epochs and event-driven apps, for the fuzzer."""

import random
import zlib

from bench.decoders.data import Made, simple, text
from bench.decoders.run import Target
from swarm.core import snapshot_fields
from swarm.core.asynchronous import Asynchronous
from swarm.core.epochs.epochs import Epochs
from swarm.core.epochs.notes import NONE, Ballot, EpochNote, Offer, SavedEpochs, Vote, first, following
from swarm.core.lockstep.frames import Channel, HeardNeighbour, Snapshot, decode_frame, encode_step, encode_want
from swarm.core.lockstep.lockstep import Lockstep
from swarm.errors import FrameError, LocalError, PayloadError
from swarm.messages import codec

_MEMBERS = ("r0", "r1", "r2")
_BEGIN = first(_MEMBERS, (("r0", "r1"), ("r1", "r2")), 0)
_NEXT = following(_BEGIN, "r1", 7, ("r0", "r1"), ("r0", "r1"), (("r0", "r1"),), ("r2",), (7,), forced=False)
_NOTES = tuple(
    note.encode()
    for note in (
        EpochNote("r0", 3, 9, _BEGIN, 8, True, ("r2",), Ballot(2, "r1"), Vote(Ballot(2, "r1"), _NEXT), None, 0),
        EpochNote("r2", 3, 9, _NEXT, -1, False, (), NONE, None, Offer(Ballot(4, "r2"), _NEXT, True), 7),
        EpochNote("r1", 3, 9, _BEGIN, 8, True, (), Ballot(4, "r2"), None, Offer(Ballot(4, "r2"), None, False), 0),
    )
)


def _epochs(rng: random.Random) -> Made:
    """Notes to the membership of r1, while time passes; what it tells must be a note for the others."""
    epochs = Epochs("r1", _MEMBERS, (1, 2), 3, _BEGIN, None, auto=True)
    now = 0.0

    def feed(data: bytes) -> None:
        nonlocal now
        now += rng.random() * 0.2
        epochs.receive(data, now)
        if rng.random() < 0.3:
            epochs.settle()
            epochs.k = max(epochs.k, epochs.epoch.k)
            epochs.suspect(("r2",) if rng.random() < 0.5 else (), now)
        epochs.handle_timer(now)
        for action in epochs.actions():
            if (told := getattr(action, "data", None)) is not None and told is not data:
                EpochNote.decode(told)

    return _NOTES, feed


_RUN, _SCHEMA = 0xA1, 0x9F3C21AA


def _lockstep(rng: random.Random) -> Made:
    """Frames of the neighbours of a robot in lockstep."""
    cores = [Lockstep("r1", ("r0", "r2"), Channel(_RUN, 0, 5, _SCHEMA), 8)]
    cores[0].start(bytes(8), 0.0)
    now = 0.0

    def feed(data: bytes) -> None:
        nonlocal now
        now += rng.random() * 0.1
        core = cores[0]
        sender = _MEMBERS[int(rng.random() * 3)]
        core.receive(sender, Channel(_RUN, 0, int(rng.random() * 3) if sender != "r1" else 1, _SCHEMA), data, now)
        core.handle_timer(now)
        for action in core.actions():
            if type(action).__name__ == "Compute":
                core.computed(bytes(8), b"", now)
        core.actions()
        if core.fault is not None:
            cores[0] = Lockstep("r1", ("r0", "r2"), Channel(_RUN, 0, 5, _SCHEMA), 8)
            cores[0].start(bytes(8), now)

    return [encode_step(0, bytes(8), None), encode_step(1, bytes(8), bytes(8)), encode_want(0), encode_want(1)], feed


def _asynchronous(rng: random.Random) -> Made:
    """Frames of the neighbours of a robot with an event-driven app."""
    core = Asynchronous("r1", ("r0", "r2"), Channel(_RUN, 0, 5, _SCHEMA), 8, _MEMBERS, period=0.1, barrier=True)
    core.begin(0.0)
    now = 0.0

    def feed(data: bytes) -> None:
        nonlocal now
        now += rng.random() * 0.1
        sender = ("r0", "r2")[int(rng.random() * 2)]
        core.receive(sender, Channel(_RUN, 0, int(rng.random() * 9), _SCHEMA), data, now)
        for action in core.actions():
            if type(action).__name__ == "Call":
                core.returned(bytes(8), now)
        core.handle_timer(now)

    frame = b"\x01" + (5).to_bytes(4, "little") + bytes(8)
    return [frame, b"\x00" + frame[1:] + b"\x07"], feed


def _snapshots(rng: random.Random) -> Made:
    """Snapshots; half of them with a checksum that is right, as another version might have left them."""
    heard = {"r0": HeardNeighbour(3, 6, [bytes(8), None, bytes(8)]), "r2": HeardNeighbour()}
    golden = Snapshot(
        _RUN, 0, _SCHEMA, 8, 6, bytes(8), bytes(8), heard, snapshot_fields.pack_private({"a": (1, [2.0])})
    ).encode()

    def feed(data: bytes) -> None:
        if rng.random() < 0.5:
            data = data[:-4] + zlib.crc32(data[:-4]).to_bytes(4, "little")
        Snapshot.decode(data)

    return [golden], feed


TARGETS = (
    Target("lockstep: frames and channels", ("swarm/core/lockstep/frames.py",),
           simple([encode_step(1, bytes(8), bytes(8)), b"00000000000000a1-0-3-9f3c21aa"],
                  lambda data: decode_frame(data, 8), text(Channel.parse)), (FrameError,)),
    Target("lockstep: frames to a core", ("swarm/core/lockstep/frames.py",), _lockstep),
    Target("asynchronous: frames to a core", ("swarm/core/asynchronous.py",), _asynchronous),
    Target("epochs: notes", ("swarm/core/epochs/notes.py", "swarm/messages/codec.py"), simple(_NOTES, EpochNote.decode),
           (PayloadError,)),
    Target("epochs: notes to a core", ("swarm/core/epochs/notes.py",), _epochs),
    Target("ballots", ("swarm/core/epochs/notes.py", "swarm/messages/codec.py"),
           simple([codec.encode(SavedEpochs(1, 2, EpochNote.decode(note))) for note in _NOTES],
                  lambda data: codec.decode(SavedEpochs, data, "ballot")), (PayloadError,)),
    Target("snapshots", ("swarm/core/lockstep/frames.py",), _snapshots, (LocalError,)),
)  # fmt: skip
