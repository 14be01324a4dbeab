"""The interface of a bus as its clients use it: `swarm.bus.zenoh_bus.Bus` in a process, an in-memory one in virtual
time.

A client that keeps to this (and takes its clock as an argument) is the same code in both.
"""

from collections.abc import Callable, Iterable
from typing import Protocol

OnSample = Callable[[str, bytes], None]
"""Called with key and payload."""
OnQuery = Callable[[str, dict[str, str]], bytes | None]
"""Called with key and parameters; gives the answer, or None for none."""
Now = Callable[[], float]
"""Gives the time, s: `swarm.clock.now` in a process."""


class BusLike(Protocol):
    """See `swarm.bus.zenoh_bus.Bus`, whose docstrings hold here, too."""

    @property
    def connected(self) -> bool:
        """Whether the router is there at this moment."""

    def on_change(self, callback: Callable[[bool], None]) -> None:
        """Call `callback(connected)` whenever the router comes or goes; at once where it is there."""

    def publish(self, key: str, message: object, *, urgent: bool = False) -> None:
        """Send a message dataclass or raw bytes; silently lost while the router is away."""

    def wanted(self, key: str) -> bool:
        """Return whether anybody hears what is published under a key."""

    def subscribe(self, keys: str | Iterable[str], callback: OnSample) -> object:
        """Call `callback(key, payload)` for every sample of other sessions."""

    def serve(self, key: str, answer: OnQuery) -> None:
        """Answer queries on `key` by `answer(key, parameters)`; None leaves a query unanswered."""

    def ask(self, key: str, on_reply: OnSample, *, timeout_s: float = 1.0, **parameters: object) -> None:
        """Send a query; `on_reply(key, payload)` is called for each answer. No answer, no call."""

    def announce(self, key: str) -> None:
        """Declare a liveliness token."""

    def watch(self, key: str, callback: Callable[[str, bool], None]) -> None:
        """Call `callback(key, alive)` when tokens matching `key` come and go."""
