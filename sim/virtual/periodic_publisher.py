"""Publishing at fixed intervals under virtual time, as long as somebody listens.

Mostly nobody does. In a large swarm most events only found that out, at one robot after the other, and each look had
to fetch a robot's objects from memory.
"""

from collections.abc import Callable

from sim.virtual.bus import VirtualBus
from sim.virtual.events import Time


class PeriodicPublisher:
    """Calls at fixed intervals. It falls asleep where nobody hears its keys, and goes on in step when somebody does."""

    def __init__(
        self, time: Time, bus: VirtualBus, keys: tuple[str, ...], period: float, first: float, call: Callable[[], None]
    ) -> None:
        """`call()` publishes on some of `keys`, every `period` s from the time `first` on."""
        self._time = time
        self._bus = bus
        self._keys = keys
        self._period = period
        self._call = call
        self._last = first
        time.at(first, self._due)

    def _due(self) -> None:
        self._last = self._time.now
        if any(map(self._bus.wanted, self._keys)):
            self._time.at(self._last + self._period, self._due)
            self._call()
        else:
            self._bus.await_change(self._wake)

    def _wake(self) -> None:
        """Go on at the next multiple of the period if somebody hears one of the keys; else sleep on."""
        if not any(map(self._bus.wanted, self._keys)):
            self._bus.await_change(self._wake)
            return
        while (then := self._time.when(self._last + self._period)) <= self._time.now:
            self._last = then
        self._time.at(self._last + self._period, self._due)
