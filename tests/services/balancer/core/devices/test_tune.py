"""Notes: from Hz, seconds and volume to what the firmware plays."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.balancer.core.devices.tune import Player, check_notes, loudness, pitch, tunes
from services.balancer.core.slack.wire_time import LONGEST
from swarm.errors import LocalError
from swarm.messages import Note, SetNotes

notes = st.builds(
    Note, st.just(0.0) | st.floats(16.0, 8000.0), st.floats(0.01, 2.55), st.sampled_from([0.0, 0.1, 0.5, 1.0])
)


def test_a_tune_has_these_bytes() -> None:
    melody = SetNotes((Note(440.0, 0.5, 1.0), Note(0.0, 0.1, 1.0), Note(4186.0, 2.55, 0.5)))
    assert tunes(melody) == [
        (bytes.fromhex("0f 45 32 00 0a"), pytest.approx(0.6)),
        (bytes.fromhex("0e 6c ff"), pytest.approx(2.55)),
    ]
    assert tunes(SetNotes(())) == [(b"\0", 0.0)]


@pytest.mark.parametrize(("hertz", "midi"), [(16.0, 12), (16.35, 12), (261.63, 60), (440, 69), (450, 69), (8000, 119)])
def test_a_note_gets_the_nearest_semitone(hertz: float, midi: int) -> None:
    assert pitch(hertz) == midi


@pytest.mark.parametrize(("volume", "level"), [(0.0, 0), (1e-9, 1), (0.25, 13), (0.5, 14), (1.0, 15)])
def test_each_step_of_loudness_halves_the_volume(volume: float, level: int) -> None:
    assert loudness(volume) == level


@given(st.lists(notes, max_size=64).map(tuple).map(SetNotes))
def test_all_notes_are_played_in_order_and_for_their_time(melody: SetNotes) -> None:
    check_notes(melody)
    written = tunes(melody)
    assert all(1 + len(tune) <= LONGEST for tune, _ in written)
    played = [(tune[0], *tune[at : at + 2]) for tune, _ in written for at in range(1, len(tune), 2)]
    assert played == [(loudness(n.volume), pitch(n.frequency), round(n.duration * 100)) for n in melody.notes]
    assert sum(length for _, length in written) == pytest.approx(sum(n[2] for n in played) / 100)


@given(st.floats(16.4, 7900.0))
def test_a_pitch_is_within_half_a_semitone(hertz: float) -> None:
    assert abs(12 * math.log2(hertz / 440) + 69 - pitch(hertz)) <= 0.5 + 1e-9


@pytest.mark.parametrize(
    ("note", "field"),
    [
        (Note(15.0, 0.1, 1.0), "frequency"),
        (Note(-440.0, 0.1, 1.0), "frequency"),
        (Note(9000.0, 0.1, 1.0), "frequency"),
        (Note(440.0, 0.0, 1.0), "duration"),
        (Note(440.0, 2.6, 1.0), "duration"),
        (Note(440.0, 0.1, 1.1), "volume"),
        (Note(440.0, 0.1, -0.1), "volume"),
    ],
)
def test_what_cannot_be_played_is_refused_by_name(note: Note, field: str) -> None:
    with pytest.raises(LocalError, match=rf"notes\[1\].{field}"):
        check_notes(SetNotes((Note(0.0, 0.1, 0.0), note)))


def test_too_many_notes_are_refused() -> None:
    with pytest.raises(LocalError, match="65 of them, at most 64"):
        check_notes(SetNotes((Note(440.0, 0.1, 1.0),) * 65))


def test_a_long_melody_follows_when_its_turn_comes() -> None:
    player = Player()
    player.play(SetNotes((Note(440.0, 0.1, 1.0),) * 20), 1.0)
    assert len(player.next(1.0).data) == 32
    player.take(b"", 1.0)
    assert player.next(2.4) is None
    assert len(player.next(2.51).data) == 1 + 1 + 10
    player.play(SetNotes(()), 2.6)
    assert player.next(2.6).data == bytes((160, 0)), "silence comes at once"
    player.take(b"", 2.6)
    assert player.next(99.0) is None


def test_a_tune_that_cannot_be_written_is_given_up() -> None:
    player = Player()
    player.play(SetNotes((Note(440.0, 0.1, 1.0),)), 1.0)
    for _ in range(3):
        assert player.next(1.0) is not None
        player.fail(OSError(121, "Remote I/O error"), 1.0)
    assert player.next(1.0) is None
