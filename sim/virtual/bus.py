"""A robot's bus in memory, with the methods of `swarm.bus.zenoh_bus.Bus`: what talks to that one runs here unchanged.

A message reaches the callbacks of other sessions at the same moment of virtual time, after the call that published it:
as on the real bus nobody is called from within his own publishing. Nothing is lost, the router never goes away.
"""

from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import NamedTuple

from services.mesh.core.relay import matches
from sim.virtual.events import EventQueue
from swarm.bus.packer import Packer
from swarm.bus.protocol import OnQuery, OnSample
from swarm.errors import LocalError
from swarm.messages.keys import MAX_KEY_LENGTH


class _Subscription(NamedTuple):
    expression: str
    stem: str
    """The chunks before its first wildcard. Most keys do not begin with them."""
    session: "VirtualBus"
    callback: OnSample

    def takes(self, key: str) -> bool:
        if not key.startswith(self.stem):
            return False
        return matches(self.expression, key) if len(self.stem) < len(self.expression) else key == self.stem


@dataclass
class VirtualRouter:
    """The part that the sessions of one robot share."""

    time: EventQueue
    subscriptions: list[_Subscription] = field(default_factory=list)
    servers: dict[str, tuple["VirtualBus", OnQuery]] = field(default_factory=dict)
    tokens: list[tuple["VirtualBus", str]] = field(default_factory=list)
    watchers: list[tuple["VirtualBus", str, Callable[[str, bool], None]]] = field(default_factory=list)
    sessions: list["VirtualBus"] = field(default_factory=list)
    waiting: list[tuple["VirtualBus", Callable[[], None]]] = field(default_factory=list)
    """What each session wants to be called when somebody hears other keys."""

    def changed(self) -> None:
        """Look again who is interested in which key."""
        for session in self.sessions:
            session.targets.clear()
        waiting, self.waiting = self.waiting, []
        for _, call in waiting:
            call()

    def tell(self, token: str, *, alive: bool) -> None:
        """Tell the watchers of a liveliness token that it has come or gone."""
        for _, expression, callback in self.watchers:
            if matches(expression, token):
                self.time.soon(callback, token, alive)


class VirtualSubscription:
    """One subscription of a session, until it is closed."""

    def __init__(self, router: VirtualRouter, entries: list[_Subscription]) -> None:
        self._router, self._entries = router, entries

    def close(self) -> None:
        """Hear no more; safe to call twice."""
        gone = set(map(id, self._entries))
        self._router.subscriptions = [each for each in self._router.subscriptions if id(each) not in gone]
        self._router.changed()


class VirtualBus:
    """One session of a robot's bus."""

    connected = True

    def __init__(self, router: VirtualRouter) -> None:
        self._router = router
        self._time = router.time
        self._closed = False
        self.counters: Counter[str] = Counter()
        """The numbers of dropped messages, by name."""
        self._packer = Packer(self.counters)
        self.targets: dict[str, tuple[OnSample, ...]] = {}
        """The receivers of messages of this session, by key, for the keys used so far."""
        router.sessions.append(self)

    def on_change(self, callback: Callable[[bool], None]) -> None:
        self._time.soon(callback, True)

    def hearers(self, key: str) -> tuple[OnSample, ...]:
        """Return the callbacks that hear what this session publishes under `key`."""
        return self._targets(key)

    def wanted(self, key: str) -> bool:
        """Return whether anybody hears what this session publishes there: making a message may cost more than
        sending it."""
        return bool(self._targets(key))

    def await_change(self, call: Callable[[], None]) -> None:
        """Call once, as soon as other keys may be `wanted` than now."""
        if not self._closed:
            self._router.waiting.append((self, call))

    def publish(self, key: str, message: object, *, urgent: bool = False) -> None:
        """Send to all other sessions that subscribe to it; drop what the real bus drops, raise what it raises."""
        if len(key) > MAX_KEY_LENGTH:
            raise LocalError(f"key {key[:40]!r}...: longer than {MAX_KEY_LENGTH} characters")
        targets = self.targets.get(key)
        if targets is None:
            targets = self._targets(key)
        if not targets:
            return
        payload = self._packer.pack(key, message)
        if payload is None:
            return
        soon = self._time.soon
        for callback in targets:
            soon(callback, key, payload)

    def subscribe(self, keys: str | Iterable[str], callback: OnSample) -> VirtualSubscription:
        """Call `callback(key, payload)` for every sample of other sessions, until what is returned is closed."""
        expressions = (keys,) if isinstance(keys, str) else keys
        entries = [_Subscription(each, each.partition("*")[0].rstrip("/"), self, callback) for each in expressions]
        self._router.subscriptions += entries
        self._router.changed()
        return VirtualSubscription(self._router, entries)

    def serve(self, key: str, answer: OnQuery) -> None:
        """Answer queries on `key` by `answer(key, parameters)`; None leaves a query unanswered."""
        self._router.servers[key] = self, answer

    def ask(self, key: str, on_reply: OnSample, *, timeout_s: float = 1.0, **parameters: object) -> None:
        """Send a query; `on_reply(key, payload)` is called for each answer."""
        self._time.soon(self._query, key, on_reply, {name: str(value) for name, value in parameters.items()})

    def announce(self, key: str) -> None:
        """Declare a liveliness token, which lives as long as the session."""
        self._router.tokens.append((self, key))
        self._router.tell(key, alive=True)

    def watch(self, key: str, callback: Callable[[str, bool], None]) -> None:
        """Call `callback(key, True)` for each token, and with False when its session ends."""
        self._router.watchers.append((self, key, callback))
        for _, token in self._router.tokens:
            if matches(key, token):
                self._time.soon(callback, token, True)

    def close(self) -> None:
        """Hear and say nothing any more."""
        router = self._router
        self._closed = True
        self.targets.clear()
        router.subscriptions = [each for each in router.subscriptions if each.session is not self]
        router.servers = {key: server for key, server in router.servers.items() if server[0] is not self}
        router.waiting = [each for each in router.waiting if each[0] is not self]
        router.watchers = [each for each in router.watchers if each[0] is not self]
        ended = [token for session, token in router.tokens if session is self]
        router.tokens = [each for each in router.tokens if each[0] is not self]
        router.sessions.remove(self)
        for token in ended:
            router.tell(token, alive=False)
        router.changed()

    def _targets(self, key: str) -> tuple[OnSample, ...]:
        found = self.targets.get(key)
        if found is None:
            found = self.targets[key] = tuple(
                each.callback
                for each in self._router.subscriptions
                if each.session is not self and each.takes(key) and not self._closed
            )
        return found

    def _query(self, key: str, on_reply: OnSample, parameters: dict[str, str]) -> None:
        for name, (_, answer) in tuple(self._router.servers.items()):
            if matches(key, name) and (payload := answer(name, parameters)) is not None:
                on_reply(name, payload)
