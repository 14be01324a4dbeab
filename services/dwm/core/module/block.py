"""The balancer's reports of a DWM1001 that is wired to the ATmega32U4 (`balancer/uwb`), in the form of a poller's."""

from services.dwm.core.module.poller import ModuleHealth, ModuleReport
from services.dwm.core.module.tlv import ERRORS, AnchorRange, Location, Position
from swarm.messages import Uwb

PATIENCE = 3.0
"""Seconds without a message after which the source counts as silent: the balancer publishes at least once a second."""

_TROUBLES = {
    "silent": "the module does not answer the ATmega: is it wired (its TX to pin 0), powered and in generic mode?",
    "broken": "the module's answers to the ATmega are broken: shell mode, a bad wire, or another firmware? "
    "See `swarm dwm check`",
}
_NOBODY = "the balancer tells nothing of the module (balancer/uwb): is it running?"
_FAILURES = 3
"""Messages in a row with the same trouble after which it is reported: one broken answer is no trouble."""


class Block:
    """Turns messages into reports and health; told on change only."""

    def __init__(self, now: float) -> None:
        self._heard = now
        self._sequence = 0
        self._told: str | None = None
        self._state, self._times = "", 0

    def receive(self, block: Uwb, now: float) -> list[ModuleReport | ModuleHealth]:
        """Take a message of the balancer."""
        self._heard = now
        self._times = self._times + 1 if block.state == self._state else 1
        self._state = block.state
        events: list[ModuleReport | ModuleHealth] = []
        reason = self._trouble(block)
        if reason is not None:
            events += self._tell(reason)
        if block.sequence not in (0, self._sequence):
            events.append(ModuleReport(location(block), max(0.0, now - block.t) + block.age))
        self._sequence = block.sequence
        return events

    def handle_timer(self, now: float) -> list[ModuleReport | ModuleHealth]:
        """Notice silence; call it at least once a second."""
        return self._tell(_NOBODY) if now - self._heard > PATIENCE else []

    def _trouble(self, block: Uwb) -> str | None:
        """Explain what is wrong; empty where nothing is, None where the message does not decide it."""
        if block.state == "ok":
            return ""
        if self._times < _FAILURES:
            return None
        if block.state == "refused":
            return f"the module refuses the ATmega's loc_get: {ERRORS.get(block.error, f'error {block.error}')}"
        return _TROUBLES.get(block.state)

    def _tell(self, reason: str) -> list[ModuleReport | ModuleHealth]:
        if reason == self._told:
            return []
        self._told = reason
        return [ModuleHealth(not reason, reason)]


def location(block: Uwb) -> Location:
    """Return the report as the module gave it to the ATmega."""
    ranges = [
        AnchorRange(item.anchor, item.distance, item.quality, Position(item.x, item.y, item.z, item.place_quality))
        for item in block.ranges
    ]
    return Location(Position(block.x, block.y, block.z, block.quality), tuple(ranges))
