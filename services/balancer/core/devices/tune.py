"""The buzzer: notes as the firmware plays them, a tune of 15 notes of one loudness at a time (firmware/tune.h)."""

import math

from services.balancer.core.devices import balboa
from services.balancer.core.slack.transfers import write
from services.balancer.core.slack.wire_time import WHOLE, Room, Transfer
from swarm.errors import LocalError
from swarm.messages import SetNotes

LOWEST_HZ, HIGHEST_HZ = 16.0, 8000.0
"""What the buzzer's timer can do: MIDI notes 12 (16.35 Hz) to 119 (7902 Hz)."""
LONGEST_S = 2.55
MOST_NOTES = 64
LOUDEST = 15
TRIES = 3

_UNIT_S = 0.01


def check_notes(notes: SetNotes) -> None:
    """Raises `LocalError` where they cannot be played."""
    if len(notes.notes) > MOST_NOTES:
        raise LocalError(f"notes: {len(notes.notes)} of them, at most {MOST_NOTES}")
    for number, note in enumerate(notes.notes):
        if not (note.frequency == 0.0 or LOWEST_HZ <= note.frequency <= HIGHEST_HZ):
            expected = f"0 (a rest) or {LOWEST_HZ:g} to {HIGHEST_HZ:g}"
            raise LocalError(f"notes[{number}].frequency: {note.frequency:g} Hz, expected {expected}")
        if not _UNIT_S <= note.duration <= LONGEST_S:
            raise LocalError(f"notes[{number}].duration: {note.duration:g} s, expected {_UNIT_S:g} to {LONGEST_S:g}")
        if not 0.0 <= note.volume <= 1.0:
            raise LocalError(f"notes[{number}].volume: {note.volume:g}, expected 0 to 1")


def pitch(frequency: float) -> int:
    """MIDI number of the semitone nearest to a frequency in Hz; 0 for a rest."""
    return min(119, max(12, round(69 + 12 * math.log2(frequency / 440)))) if frequency else 0


def loudness(volume: float) -> int:
    """Return the loudness from 0 to 15, each step half as loud, for a volume of 0 to 1."""
    return max(1, LOUDEST + round(math.log2(volume))) if volume > 0.0 else 0


def tunes(notes: SetNotes) -> list[tuple[bytes, float]]:
    """Return the bytes to write at NOTES, one after the other, and how long each lasts, s. Without notes they end a
    tune."""
    result: list[tuple[bytearray, float]] = []
    for note in notes.notes:
        level = loudness(note.volume)
        if not result or result[-1][0][0] != level or len(result[-1][0]) > 2 * balboa.TUNE_NOTES:
            result.append((bytearray((level,)), 0.0))
        duration = round(note.duration / _UNIT_S)
        tune, length = result[-1]
        tune += bytes((pitch(note.frequency), duration))
        result[-1] = tune, length + duration * _UNIT_S
    return [(bytes(tune), length) for tune, length in result] or [(bytes((0,)), 0.0)]


class Player:
    """A slack task: writes the tunes of a melody when each one's turn comes."""

    def __init__(self) -> None:
        self._tunes: list[tuple[bytes, float]] = []
        self._due = 0.0
        self._notes = 0
        """The number of notes of the first tune that were written last."""
        self._failures = 0

    def play(self, notes: SetNotes, now: float) -> None:
        """Instead of whatever plays."""
        self._tunes, self._due, self._failures = tunes(notes), now, 0

    def next(self, now: float, room: Room = WHOLE) -> Transfer | None:
        """See `SlackTask`. Where a tune does not fit, its first notes come first."""
        if not self._tunes or now < self._due:
            return None
        tune = self._tunes[0][0]
        self._notes = min(len(tune) // 2, max(1, (room.write - 1) // 2))
        return write(balboa.NOTES, tune[: 1 + 2 * self._notes])

    def take(self, data: bytes, now: float) -> None:
        del data
        tune, seconds = self._tunes.pop(0)
        end = 1 + 2 * self._notes
        if end < len(tune):
            seconds = sum(tune[2:end:2]) * _UNIT_S
            self._tunes.insert(0, (tune[:1] + tune[end:], sum(tune[end + 1 :: 2]) * _UNIT_S))
        self._due = now + seconds
        self._failures = 0

    def fail(self, error: OSError, now: float) -> None:
        del error, now
        self._failures += 1
        if self._failures >= TRIES:
            self._tunes.clear()
