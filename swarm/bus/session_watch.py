"""A watch on a process' session: where the router answers nothing in it, no stop would be heard."""

from swarm.bus.zenoh_bus import ROUTER, Bus
from swarm.errors import BusError
from swarm.process.edges import defect

ASK_S = 1.0
"""Seconds between two questions to the router."""


class SessionWatch:
    """Asks the router for a sign of life. Where it has given none for long, Zenoh's thread hangs, or its connection is
    dead."""

    def __init__(self, bus: Bus, most: int) -> None:
        """`most`: questions in a row without an answer after which this process ends. They are counted, not timed: a
        process that got no processor time has asked nothing meanwhile."""
        self._bus = bus
        self._most = most
        self._unanswered = 0
        """Questions since the last answer."""

    def look(self) -> None:
        """Ask once more, or end this process by a defect, so that another one is started. Call it each `ASK_S`."""
        if not self._bus.connected:  # the bus is away: another process would hear no more
            self._unanswered = 0
            return
        if self._unanswered >= self._most:
            problem = f"{self._most} questions to the router were not answered: no stop would be heard"
            defect(BusError(problem), "the bus")
        self._unanswered += 1
        self._bus.ask(ROUTER, self._answered, timeout_s=self._most * ASK_S)

    def _answered(self, _name: str, _payload: bytes) -> None:
        """Take the router's answer. Zenoh's thread calls this."""
        self._unanswered = 0
