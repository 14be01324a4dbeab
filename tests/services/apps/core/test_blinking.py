"""When LEDs blink: by common time, and by algorithm 3 of the thesis with its drift."""

from itertools import pairwise

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from services.apps.core import algorithm3
from services.apps.core.blink import GRID_PER_HZ, edges, on_grid

FREQUENCY = st.floats(0.1, 10.0)
START = st.floats(0.0, 1e6)


@given(FREQUENCY, START, st.floats(0.0, 3.0))
def test_edges_alternate_at_the_frequency(frequency: float, begin: float, length: float) -> None:
    found = list(edges(frequency, begin, begin + length))
    assert all(begin <= edge.t < begin + length for edge in found)
    for a, b in pairwise(found):
        assert a.on != b.on
        assert b.t - a.t == pytest.approx(0.5 / frequency, abs=1e-8)
    for edge in found:
        assert edge.t * frequency * 2 == pytest.approx(round(edge.t * frequency * 2), abs=1e-4)


@given(FREQUENCY, START, st.lists(st.floats(0.01, 0.7), min_size=1, max_size=10))
def test_windows_one_after_the_other_give_what_one_gives(frequency: float, begin: float, lengths: list[float]) -> None:
    found, at = [], begin
    for length in lengths:
        found += edges(frequency, at, at + length)
        at += length
    assert found == list(edges(frequency, begin, at))


@given(FREQUENCY)
def test_the_grid_is_near_and_takes_what_rounding_left(frequency: float) -> None:
    agreed = on_grid(frequency)
    assert agreed == pytest.approx(frequency, abs=0.5 / GRID_PER_HZ + 1e-12)
    assert on_grid(agreed) == agreed


@given(st.lists(st.integers(10, 1000), min_size=2, max_size=12))
@example([200, 201, 201, 201, 200, 201, 201, 200])
def test_means_of_chosen_frequencies_are_not_between_two_lines(hundredths: list[int]) -> None:
    mean = sum(hundredths) / 100 / len(hundredths)
    assert on_grid(mean * (1 + 1e-12)) == on_grid(mean * (1 - 1e-12))


def fire(frequency: float, tolerance: float, overhead: float, seconds: float) -> list[tuple[float, float]]:
    """Times and phases of the blinks of one robot alone, its loop's waits each `overhead` too long."""
    blink, now, phase, fired = algorithm3.Blink(tolerance), 1000.0, 0.5 / frequency, []
    off, on, rest = blink.waits(frequency)
    while now < 1000.0 + seconds:
        look = blink.look(now, frequency, phase)
        if look.fires:
            phase = look.phase
            fired.append((now, phase))
            now += off + on + 2 * overhead
        now += rest + overhead
    return fired


@pytest.mark.parametrize(
    ("frequency", "tolerance", "overhead", "drifts_to"),
    [(2.1, 1 / 16, 0.0, 2.191), (2.1, 1 / 16, 1e-3, 2.17), (3.74, 1 / 64, 0.0, 3.779), (3.74, 1 / 64, 1e-3, 3.756)],
)
def test_blinking_drifts_as_in_the_thesis_until_the_phase_is_zero(frequency, tolerance, overhead, drifts_to) -> None:
    """Thesis 4.3.2: 2.1 Hz become 2.2, 3.74 Hz become 3.76; then the agreed frequency, with the phase at zero."""
    fired = fire(frequency, tolerance, overhead, 120.0)
    begin, end = fired[:6], fired[-60:]
    assert 5 / (begin[-1][0] - begin[0][0]) == pytest.approx(drifts_to, abs=0.006)
    assert 59 / (end[-1][0] - end[0][0]) == pytest.approx(frequency, rel=1e-3)
    assert max(phase for _, phase in end) < 1.5 * tolerance / frequency


@given(FREQUENCY, st.sampled_from([1 / 16, 1 / 32, 1 / 64]), START, st.floats(0.0, 1.0))
def test_a_look_fires_within_the_tolerance_only(frequency, tolerance, t, share) -> None:
    look = algorithm3.Blink(tolerance).look(t, frequency, share / frequency)
    assert 0.0 <= look.phase <= 1 / frequency
    assert look.fires == (abs(look.phase - share / frequency) <= tolerance / frequency)
