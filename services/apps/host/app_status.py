"""The status of an app on the bus: `state`, `state/throttled` and `progress`, published and answered."""

import math
from collections.abc import Callable

from swarm.bus.throttle import APP_STATE_S, THROTTLED, Throttle
from swarm.messages import AppProgress, AppState
from swarm.messages.codec import encode
from swarm.messages.keys import key
from swarm.process.runtime import Runtime

LOOK_EVERY = 0.1
"""Seconds between two looks whether there is something new: it goes to people and programs that watch. At 25 Hz this
took a fifth of an app's CPU time."""
REPEAT = 1.0
"""Seconds between two messages of progress and state when nothing changes."""


class AppStatus:
    """State and progress of an app, or of one lockstep in it."""

    def __init__(
        self,
        runtime: Runtime,
        topics: str,
        progress: Callable[[], AppProgress],
        state: Callable[[], AppState | None],
    ) -> None:
        """`topics` is the part of the keys behind the robot. `state()` gives None while there is no state to be looked
        at, since a step of the app runs or none has been done."""
        self.late = False
        """Whether the state was to be published while there was none to be looked at."""
        self._runtime = runtime
        self._bus = runtime.bus
        self._progress = progress
        self._look_at = state
        self._state: AppState | None = None
        self._state_key, self._progress_key = (key(runtime.robot, topics, what) for what in ("state", "progress"))
        self._throttle = Throttle(self._bus, self._state_key, APP_STATE_S)
        self._published: tuple[int, float] | None = None
        self._told: tuple[object, ...] = ()
        self._told_at = -math.inf
        self._bus.serve(self._state_key, self._answer_state)
        self._bus.serve(self._progress_key, lambda *_: encode(progress()))

    @property
    def keys(self) -> tuple[str, ...]:
        """Return the keys under which the status is published."""
        return self._state_key, f"{self._state_key}/{THROTTLED}", self._progress_key

    def look(self) -> tuple[bool, bool]:
        """Publish state and progress where they are new, or were told a while ago. Tells whether all was repeated, and
        whether the progress was new."""
        now, progress = self._runtime.now, self._progress()
        repeat = now - self._told_at >= REPEAT
        self.publish_state(always=repeat, news=repeat or progress.phase == "done")
        told = progress.phase, progress.waiting_for, progress.reason
        new = told != self._told
        if repeat or new:
            self._told, self._told_at = told, now
            self._bus.publish(self._progress_key, progress)
        return repeat, new

    def publish_state(self, *, always: bool = True, news: bool = False) -> None:
        """Publish the state: `always`, or where it is another one than before. `news` is not throttled."""
        self.late = False  # what is computed for this look, perhaps at once, is published by this look
        self.late = not self._refresh()
        state = self._state
        if state is None or self.late:
            return
        if always or self._published != (state.k, state.t):
            self._published = state.k, state.t
            self._bus.publish(self._state_key, state)
            self._throttle.publish(state, self._runtime.now, news=news)

    def _refresh(self) -> bool:
        """Bring the state up to date; False where there is none to be looked at."""
        state = self._look_at()
        if state is not None:
            self._state = state
        return state is not None

    def _answer_state(self, *_: object) -> bytes | None:
        self._refresh()
        return None if self._state is None else encode(self._state)
