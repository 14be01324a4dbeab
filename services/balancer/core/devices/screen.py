"""The text on the display: name, state, battery, and the text of an app or a person."""

import math

from services.balancer.core.devices.display import LETTERS_PER_LINE, ScreenText
from swarm.messages import AppState, BalancerState

TEXT_LINES = 4
PERIOD_S = 0.5
"""Least time between two changes."""


def wrap(text: str, lines: int) -> list[str]:
    """Wrap a text to at most `lines` lines of the display's width. Words stay whole where they fit; the rest is cut
    off."""
    wrapped: list[str] = []
    for paragraph in text.split("\n"):
        rest = paragraph
        while len(rest) > LETTERS_PER_LINE and len(wrapped) < lines:
            end = rest.rfind(" ", 1, LETTERS_PER_LINE + 1)
            end = LETTERS_PER_LINE if end < 0 else end
            wrapped.append(rest[:end])
            rest = rest[end:].lstrip(" ")
        wrapped.append(rest)
        if len(wrapped) >= lines:
            break
    return wrapped[:lines]


class Composer:
    """Puts the lines together; fed by the bridge with whatever comes by."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._state: BalancerState | None = None
        self._app = ""
        self._text = ""
        self._text_until = math.inf
        self._last: tuple[str, ...] = ()
        self._next_at = 0.0

    def take_state(self, state: BalancerState) -> None:
        """Take the body's state."""
        self._state = state

    def take_app(self, name: str, state: AppState) -> None:
        """Take as many of an app's values as fit."""
        values = [f"{field} {_short(value)}" for field, value in state.state.items()]
        self._app = "\n".join([f"{name} k={state.k}", *values])

    def take_text(self, text: str, until: float = math.inf) -> None:
        """Show a text in place of the app's values up to the time `until`, s. An empty text shows the values again."""
        self._text, self._text_until = text, until

    def lines(self, now: float) -> ScreenText | None:
        """Return the lines to show; None where they have not changed, or changed a moment ago."""
        if self._state is None or now < self._next_at:
            return None
        if now >= self._text_until:
            self.take_text("")
        state = self._state
        battery = "" if state.battery is None else f"{state.battery:.1f} V"
        mode = state.mode.replace("_", " ")
        text = wrap(state.fault or self._text or self._app, TEXT_LINES)
        lines = (self._name, mode.ljust(LETTERS_PER_LINE - len(battery)) + battery, "", *text)
        if lines == self._last:
            return None
        self._last, self._next_at = lines, now + PERIOD_S
        return ScreenText(lines)


def _short(value: object) -> str:
    if isinstance(value, float):
        return f"{value:.4g}"
    return " ".join(map(_short, value)) if isinstance(value, tuple) else str(value)
