"""Thesis algorithm 3, Blink(): an LED that fires when its own phase comes near the agreed one.

    tol = tolerance / f;  phase' = t mod 1/f
    if phase' in [phase - tol, phase + tol]: phase <- phase'; LED off; wait 1/(2f); LED on; wait 1/(3f)
    wait tol

It drifts: of its own blink it takes 5/6 of a period, then it looks every tol, and fires at the first look past
1/f - tol, since the phase it compares with is that of its last blink. So the next blink comes early: with tolerance
1/16 after 23/24 of a period (2.1 Hz become 2.19, thesis: 2.2), with 1/64 after 95/96 (3.74 Hz become 3.78, with waits
that take 1 ms longer than asked 3.76 as in the thesis). When the phase has drifted to zero it stays there: a phase
below zero appears as one near 1/f, out of reach of the tolerance, so the blink has to wait for zero. Nothing here
mends that.
"""

from typing import NamedTuple


class Look(NamedTuple):
    """The result of a look at the clock."""

    fires: bool
    phase: float
    """s: the own phase where it fires, to become the agreed one."""


class Blink:
    """The algorithm's times; waits are its user's."""

    def __init__(self, tolerance: float) -> None:
        """`tolerance` as a share of the period: the thesis' 1/16 and 1/64."""
        self.tolerance = tolerance

    def look(self, t: float, frequency: float, phase: float) -> Look:
        """Look at the common time `t` (s). `frequency` (Hz) and `phase` (s) are the consensus states."""
        own = t % (1.0 / frequency)
        tolerance = self.tolerance / frequency
        return Look(phase - tolerance <= own <= phase + tolerance, own)

    def waits(self, frequency: float) -> tuple[float, float, float]:
        """s it waits with the LED off, on, and until it looks again."""
        return 1.0 / (2.0 * frequency), 1.0 / (3.0 * frequency), self.tolerance / frequency
