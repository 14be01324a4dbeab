"""What the display says: name, state, battery, and what an app or a person wants shown."""

import math

from services.balancer.core.devices.display import LETTERS_PER_LINE, ScreenText
from swarm.messages import AppState, BalancerState

TEXT_LINES = 4
PERIOD_S = 0.5
"""Least time between two changes."""


def wrap(text: str, lines: int) -> list[str]:
    """At most `lines` lines of the display's width; words stay whole where they fit. What is left is cut off."""
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
        """The body's."""
        self._state = state

    def take_app(self, name: str, state: AppState) -> None:
        """An app's values, as many as fit."""
        values = [f"{field} {_short(value)}" for field, value in state.state.items()]
        self._app = "\n".join([f"{name} k={state.k}", *values])

    def take_text(self, text: str, until: float = math.inf) -> None:
        """What somebody wants shown instead of the app's values up to a time, s; empty = those again."""
        self._text, self._text_until = text, until

    def lines(self, now: float) -> ScreenText | None:
        """What is to be shown, None where that has not changed or changed a moment ago."""
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
