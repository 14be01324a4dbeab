"""LEDs that blink together, in frequency and phase (thesis 4.3.2). docs/reference/apps/led_sync.md."""

from collections.abc import Mapping, Sequence
from math import fsum, inf
from typing import Any

from services.apps.core import algorithm3, blink
from swarm import EventApp, SyncApp, channel, float32, parameter
from swarm.errors import AppError
from swarm.messages.codec import Value

SLOWEST, FASTEST = 0.1, 10.0
"""Hz."""

PLAN_S = 0.25
"""Seconds between two plans."""
LEAD_S = 0.05
"""The most seconds from an order to the LEDs. A change that is due earlier was ordered before."""
AHEAD_S = 0.8
"""Length of a plan in seconds: a host that stalls for half a second misses no blink."""
SETTLED_S = 1.0
"""Seconds for which the frequency must have been the same grid value to count as agreed."""


class Frequency(SyncApp):
    """Metropolis consensus: all end on the mean of the robots' frequencies, Hz."""

    value: float = 2.0

    def start(self) -> None:
        """Refuse what no LED shows."""
        check_frequency(self.value)

    def step(self, neighbours: Sequence[Any]) -> None:
        """f_i += sum_j w_ij (f_j - f_i)."""
        self.value = clamped(self.value + fsum(w * (n.value - self.value) for w, n in self.weighted(neighbours)))


class LedSync(EventApp):
    """The LED goes on at k/f of the mesh's common time: no robot tells another when it blinks.

    Consensus agrees on f. Blinks are ordered ahead, for times of the robot's own clock, so neither the links' delays
    nor a late process moves them.
    """

    frequency = channel(Frequency)
    agreed: float = 0.0
    """Hz it blinks with; 0 before consensus and clock have settled."""
    _since: float = -inf

    def start(self) -> None:
        """Show that it waits."""
        self.robot.leds(red=False, yellow=True, green=False)
        self.robot.after(PLAN_S, "plan")

    def on_timer(self, name: str) -> None:
        """Order what comes next. Each plan repeats what still lies ahead, by the newest clock and frequency."""
        robot, clock = self.robot, self.robot.clock
        robot.after(PLAN_S, name)
        now, mesh = robot.now, clock.now()
        frequency = blink.on_grid(self.frequency.value)
        if frequency != self.agreed or mesh is None:
            self.agreed, self._since = frequency, now
        if self.frequency.k == 0 or now - self._since < SETTLED_S or mesh is None:
            return
        for edge in blink.edges(frequency, mesh + LEAD_S, mesh + AHEAD_S):
            robot.leds(yellow=edge.on, at=clock.monotonic(edge.t))
            if edge.on and edge.t < mesh + LEAD_S + PLAN_S:
                robot.record("on", edge.t)

    def result(self) -> Mapping[str, Value]:
        """Frequency (Hz), and how well this robot knows the common time (standard deviation, s; -1: not yet)."""
        error = self.robot.clock.error
        return {"frequency": self.agreed, "clock_error": -1.0 if error is None else error}


class RowFrequency(Frequency):
    """Rule 4.1, the mean of the own and the neighbours' values, in float32 as the thesis sends it."""

    weights = "row"
    value: float32 = 2.0


class Phase(SyncApp):
    """Rule 4.1 on the phases, s, of which each robot's own is overwritten whenever its LED fires."""

    weights = "row"
    value: float32 = -1.0
    """-1: drawn at the start, within half a second."""
    _fired: float = -1.0
    """Input: the phase of the last blink; -1: none since the last step."""

    def start(self) -> None:
        """Begin with a random phase."""
        if self.value < 0.0:
            self.value = self.robot.random.uniform(0.0, 0.5)

    def step(self, neighbours: Sequence[Any]) -> None:
        """The mean of the own and the neighbours' values, moved as far as the last blink has moved the own one: so all
        of that reaches the others, as it does where the state is overwritten between two iterations."""
        own, fired, self._fired = self.value, self._fired, -1.0
        self.value = own + fsum(w * (n.value - own) for w, n in self.weighted(neighbours))
        if fired >= 0.0:
            self.value += fired - own


class ThesisLedSync(EventApp):
    """Algorithm 3 with two consensus processes, on the mesh's clock in place of NTP. It drifts as the thesis' did."""

    tolerance: float = parameter(0.0625, unit="1", low=0.001, high=0.25)
    """Tolerance of the phase, as a share of the period: 1/16 and 1/64 in figure 4.6."""
    overhead: float = parameter(0.001, unit="s", low=0.0, high=0.05)
    """The time by which each of the program's waits is too long: 1 ms gives the thesis' figures."""
    frequency = channel(RowFrequency)
    phase = channel(Phase)
    actual: float = 0.0
    """Hz from the last blink to this one."""
    _fired_at: float = -1.0

    def start(self) -> None:
        """The loop's first look is at once."""
        self.robot.leds(red=False, yellow=True, green=False)
        self.robot.after(0.0, "look")

    def on_timer(self, name: str) -> None:
        """Run the next line of the loop: look, on, rest."""
        frequency = float(self.frequency.value)
        _, on, rest = algorithm3.Blink(self.tolerance).waits(frequency)
        if name == "look":
            self._look(frequency)
        elif name == "on":
            self.robot.leds(yellow=True)
            self._wait(on, "rest")
        else:
            self._wait(rest, "look")

    def _look(self, frequency: float) -> None:
        blink = algorithm3.Blink(self.tolerance)
        off, _, rest = blink.waits(frequency)
        mesh = self.robot.clock.now()
        if mesh is None or self.phase.k == 0:
            self._wait(rest, "look")
            return
        look = blink.look(mesh, frequency, float(self.phase.value))
        if not look.fires:
            self._wait(rest, "look")
            return
        self.phase.feed(_fired=look.phase)
        self.robot.leds(yellow=False)
        if self._fired_at >= 0.0:
            self.actual = 1.0 / (mesh - self._fired_at)
        self._fired_at = mesh
        self.robot.record("fired", mesh)
        self.robot.record("phase", look.phase)
        self._wait(off, "on")

    def _wait(self, seconds: float, name: str) -> None:
        self.robot.after(seconds + self.overhead, name)

    def result(self) -> Mapping[str, Value]:
        """Return the agreed values, and the frequency at which the LED really blinks."""
        return {
            "frequency": float(self.frequency.value),
            "phase": float(self.phase.value),
            "actual": self.actual,
        }


def check_frequency(value: float) -> None:
    """Raises `AppError` for a frequency that no LED shows."""
    if not SLOWEST <= value <= FASTEST:
        raise AppError(f"frequency_value: expected {SLOWEST:g} to {FASTEST:g} Hz, got {value:g}")


def clamped(value: float) -> float:
    """Return the nearest frequency that an LED shows: a neighbour may tell any."""
    return min(max(value, SLOWEST), FASTEST)


ALGORITHMS = {"clock": LedSync, "thesis": ThesisLedSync}
