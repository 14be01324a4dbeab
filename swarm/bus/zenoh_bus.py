"""The one door to Zenoh. Every rule here was measured (docs/explanation/bus.md, section Bus).

Publishing never blocks longer than a millisecond and never fails for reasons outside this process: while the
router is away messages are lost, so whoever needs an answer asks again. Callbacks run on Zenoh's own receive
thread: they may only enqueue or do a short step under a lock, since a slow one holds up every other key of
the process; publishing, asking and declaring from within them is fine. The session opens in the background,
waits for a router that is not there yet, and survives its restart. Never fork with a session open: in the
child everything hangs.
"""

import contextlib
import logging
import threading
from collections import Counter
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from swarm.bus.packer import Packer
from swarm.bus.protocol import OnQuery, OnSample
from swarm.bus.publisher import Publisher
from swarm.bus.zenoh_config import client_config, peer_config, router_config
from swarm.bus.zenoh_runtime import direct, guard, text, zenoh
from swarm.errors import BusError, LocalError
from swarm.messages.keys import MAX_KEY_LENGTH
from swarm.process.end import OPENER
from swarm.process.paths import ENDPOINT_PROTOCOL, bus_endpoint

MSGPACK = "application/msgpack"
BINARY = "application/octet-stream"

ROUTER = "@/*/router"
"""The key on which a Zenoh router answers queries about itself."""

_log = logging.getLogger("bus")

_MESH = "mesh"
"""The service that all other direct ones talk to."""
_PUBLISHERS = 256
"""Keys that a session keeps declared; above, the oldest makes room."""
_OPENING = 2.0
"""Seconds that opening a session takes at most where there is a router, on a busy machine, too."""
_LOOK_S = 0.02
"""Seconds between two looks for the router's socket."""


class Router:
    """The Zenoh router of one robot, in this process, until closed. Raises `BusError` where it cannot listen.

    Zenoh removes the socket a killed router left behind, and refuses one in use by a lock file beside it.
    """

    def __init__(self, endpoint: str) -> None:
        try:
            self._session = zenoh.open(zenoh.Config.from_json5(router_config(_checked_endpoint(endpoint))))
        except zenoh.ZError as error:
            raise BusError(f"the bus cannot listen on {endpoint}: {text(error)}") from None

    def close(self) -> None:
        """Stop routing; Zenoh removes the socket file.

        A client whose connection is just being accepted is forgotten by Zenoh but not cut off: it stays connected to
        nothing until this process ends. The bus service ends at once after this.
        """
        _close(self._session)

    def __enter__(self) -> "Router":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class Subscription:
    """One subscription of a client, until it is closed."""

    def __init__(self, kept: "set[Subscription]") -> None:
        """`kept`: the set that holds it until it is closed. Zenoh undeclares what nobody holds."""
        kept.add(self)
        self._kept = kept
        self._lock = threading.Lock()
        self._closed = False
        self._subscribers: list[zenoh.Subscriber[None]] = []

    def declare(self, session: zenoh.Session, key: str, handle: Callable[[zenoh.Sample], None]) -> None:
        """Begin to hear a key, unless it has been closed meanwhile."""
        if self._closed:
            return
        subscriber = session.declare_subscriber(key, direct(handle), allowed_origin=zenoh.Locality.REMOTE)
        with self._lock:
            if not self._closed:
                self._subscribers.append(subscriber)
                return
        subscriber.undeclare()

    def close(self) -> None:
        """Hear nothing that is published from now on; what is under way may still come. Safe to call twice, not from
        within a callback."""
        with self._lock:
            self._closed = True
            subscribers, self._subscribers = self._subscribers, []
        self._kept.discard(self)
        for subscriber in subscribers:
            with contextlib.suppress(zenoh.ZError):  # with its session, or before it
                subscriber.undeclare()  # type: ignore[no-untyped-call]


class Bus:
    """A client session of one robot's router.

    Subscriptions, servers and tokens may be declared at once; they take effect when the router is found.
    Close it before the process ends (or use it as a context): an open subscriber would hang the interpreter's
    exit.
    """

    def __init__(self, endpoint: str, direct: str | None = None, lasting: str = "") -> None:
        """`endpoint` as of `swarm.process.paths.bus_endpoint`. `direct`: an endpoint of its own, at which others that
        have one reach this session without the router; `lasting`: see `peer_config`. Raises `BusError` where one is
        none."""
        self._endpoint = _checked_endpoint(endpoint)
        self._config = (
            client_config(endpoint) if direct is None else peer_config(endpoint, _checked_endpoint(direct), lasting)
        )
        self.counters: Counter[str] = Counter()
        """What was dropped, by name."""
        self._packer = Packer(self.counters)
        self._session: zenoh.Session | None = None
        self._lock = threading.Lock()
        self._pending: list[Callable[[zenoh.Session], object]] = []
        self._kept: list[object] = []
        """The objects that Zenoh returned for declarations: it undeclares what nobody holds."""
        self._subscriptions: set[Subscription] = set()
        self._publishers: dict[tuple[str, bool], Publisher] = {}
        self._watchers: list[Callable[[bool], None]] = []
        self._closed = False
        self._connected = threading.Event()
        self._ended = threading.Event()
        self._opener = threading.Thread(target=self._open, name=OPENER, daemon=True)
        self._opener.start()

    @classmethod
    def of(cls, directory: Path, direct: str | None = None) -> "Bus":
        """Return the bus of the robot whose runtime directory is `directory`. `direct`: the name of a service whose
        messages to others of its kind, the mesh above all, are too many to go through the router."""
        if direct is None:
            return cls(bus_endpoint(directory))
        lasting = "" if direct == _MESH else bus_endpoint(directory, _MESH)
        return cls(bus_endpoint(directory), bus_endpoint(directory, direct), lasting)

    @property
    def connected(self) -> bool:
        """Whether the router is there at this moment."""
        return self._connected.is_set()

    def wait_connected(self, timeout_s: float | None) -> bool:
        """Wait for the router; False when it did not come in time."""
        return self._connected.wait(timeout_s)

    def on_change(self, callback: Callable[[bool], None]) -> None:
        """Call `callback(connected)` whenever the router comes or goes; at once where it is there."""
        callback = guard(callback)
        with self._lock:
            self._watchers.append(callback)
            connected = self._connected.is_set()
        if connected:
            callback(True)

    def publish(self, key: str, message: object, *, urgent: bool = False) -> None:
        """Send a message dataclass (as msgpack) or raw bytes; silently lost while the router is away.

        `urgent` puts it ahead of the queue that a flood of other messages fills; a stop is ahead of both. A message
        that nobody hears is not looked at. A message that is too large for the bus is dropped, counted and logged; a
        stop never is. Raises `LocalError` only for a key that the bus does not take at all.
        """
        if len(key) > MAX_KEY_LENGTH:
            raise LocalError(f"key {key[:40]!r}...: longer than {MAX_KEY_LENGTH} characters")
        session = self._session
        try:
            publisher = None if session is None else self._publisher_of(session, key, urgent)
            if publisher is not None and not publisher.heard():
                return
            payload = self._packer.pack(key, message)
            if publisher is not None and payload is not None:
                publisher.put(payload, BINARY if isinstance(message, bytes | bytearray) else MSGPACK)
        except zenoh.ZError as error:
            if not self._closed:
                _log.warning("put failed key=%s error=%s", key, text(error))

    def wanted(self, key: str) -> bool:
        """Return whether anybody hears what this session publishes under a key, or a key of an expression; somebody may
        until the router has told."""
        session = self._session
        try:
            return session is not None and self._publisher_of(session, key, False).heard()
        except zenoh.ZError as error:
            if not self._closed:
                _log.warning("key=%s error=%s", key, text(error))
            return False

    def _publisher_of(self, session: zenoh.Session, key: str, urgent: bool) -> Publisher:
        publishers = self._publishers
        publisher = publishers.get((key, urgent))
        if publisher is None:
            for oldest in list(publishers)[: max(0, len(publishers) + 1 - _PUBLISHERS)]:
                publishers.pop(oldest, None)
            publisher = publishers[key, urgent] = Publisher(session, key, urgent=urgent)
        return publisher

    def subscribe(self, keys: str | Iterable[str], callback: OnSample) -> Subscription:
        """Call `callback(key, payload)` for every sample of other sessions, until what is returned, or this client, is
        closed; see above for callbacks. A sample under a key that is longer than keys may be is dropped."""
        subscription = Subscription(self._subscriptions)

        def handle(sample: zenoh.Sample) -> None:
            key = str(sample.key_expr)
            if len(key) <= MAX_KEY_LENGTH:
                callback(key, sample.payload.to_bytes())
            else:
                self.counters["long_keys"] += 1

        for key in map(_checked_key, (keys,) if isinstance(keys, str) else keys):
            self._declare(lambda session, key=key: subscription.declare(session, key, handle))  # type: ignore[misc]
        return subscription

    def serve(self, key: str, answer: OnQuery) -> None:
        """Answer queries on `key` by `answer(key, parameters)`; None leaves a query unanswered."""
        key = _checked_key(key)

        def handle(query: zenoh.Query) -> None:
            pairs = (pair.partition("=") for pair in str(query.parameters).split(";") if pair)
            payload = answer(str(query.key_expr), {name: value for name, _, value in pairs})
            if payload is not None:
                query.reply(key, payload, encoding=MSGPACK)

        self._declare(lambda session: session.declare_queryable(key, direct(handle)))

    def ask(self, key: str, on_reply: OnSample, *, timeout_s: float = 1.0, **parameters: object) -> None:
        """Send a query; `on_reply(key, payload)` is called for each answer. No answer, no call."""
        selector = _checked_key(key)
        if parameters:
            selector += "?" + ";".join(f"{name}={value}" for name, value in parameters.items())
        session = self._session
        if session is None:
            return

        def handle(reply: zenoh.Reply) -> None:
            if reply.ok is not None:
                on_reply(str(reply.ok.key_expr), reply.ok.payload.to_bytes())

        try:
            session.get(selector, direct(handle), timeout=timeout_s)
        except zenoh.ZError as error:
            if not self._closed:
                _log.warning("query failed key=%s error=%s", key, text(error))

    def announce(self, key: str) -> None:
        """Declare a liveliness token: others see `key` alive until this process ends."""
        key = _checked_key(key)
        self._declare(lambda session: session.liveliness().declare_token(key))

    def watch(self, key: str, callback: Callable[[str, bool], None]) -> None:
        """Call `callback(key, alive)` when tokens matching `key` come and go.

        The end of the router makes all of them go for a moment: wait a little before believing it.
        """
        key = _checked_key(key)

        def handle(sample: zenoh.Sample) -> None:
            callback(str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT)

        self._declare(lambda session: session.liveliness().declare_subscriber(key, direct(handle), history=True))

    def close(self) -> None:
        """Undeclare everything and close; safe to call twice and while still waiting for a router."""
        with self._lock:
            if self._closed:
                return
            self._closed = True
            session, self._session = self._session, None
        self._ended.set()
        self._connected.clear()
        if session is not None:
            _close(session)
        if self._opener is not threading.current_thread():
            # A thread that comes back from Zenoh while the interpreter ends aborts the process. With a router it is
            # back in a moment, even where the session is there and it still declares; without one it is not in Zenoh.
            self._opener.join(_OPENING)
        self._kept.clear()
        self._subscriptions.clear()

    def __enter__(self) -> "Bus":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _declare(self, declaration: Callable[[zenoh.Session], object]) -> None:
        with self._lock:
            session = self._session
            if session is None:
                self._pending.append(declaration)
        # Outside the lock: what is declared may call back at once, and the callback may declare in its turn.
        if session is not None:
            self._keep(session, declaration)

    def _keep(self, session: zenoh.Session, declaration: Callable[[zenoh.Session], object]) -> None:
        try:
            if (declared := declaration(session)) is not None:
                self._kept.append(declared)
        except zenoh.ZError as error:
            if not self._closed:
                _log.error("the bus refused a declaration: %s", text(error))

    def _open(self) -> None:
        """Runs in its own thread: `zenoh.open` waits without end, and no signal would interrupt it. So it is called
        when there is a socket."""
        socket = Path(self._endpoint.removeprefix(f"{ENDPOINT_PROTOCOL}/"))
        session = None
        while session is None:
            try:
                if socket.exists():
                    session = zenoh.open(zenoh.Config.from_json5(self._config))
            except zenoh.ZError as error:
                _log.error("the bus cannot be opened endpoint=%s error=%s", self._endpoint, text(error))
            if session is None and self._ended.wait(_LOOK_S):
                return
        while True:
            with self._lock:
                pending, self._pending = self._pending, []
                if self._closed:
                    break
                if not pending:
                    self._session = session
                    break
            for declaration in pending:
                self._keep(session, declaration)
        if self._closed:
            _close(session)
            return
        # Last, so that whoever is told of the connection can publish over it.
        self._keep(
            session,
            lambda session: session.info.declare_transport_events_listener(direct(self._on_transport), history=True),
        )

    def _on_transport(self, event: Any) -> None:
        up = event.kind == zenoh.SampleKind.PUT
        if event.transport.whatami != zenoh.WhatAmI.ROUTER:
            _log.debug("direct connection up=%s to=%s", up, event.transport.zid)
            return
        with self._lock:
            if self._closed:
                return
            (self._connected.set if up else self._connected.clear)()
            for publisher in tuple(self._publishers.values()):
                publisher.audience.doubt()
            watchers = tuple(self._watchers)
        for watcher in watchers:
            watcher(up)


def _close(session: zenoh.Session) -> None:
    """Close a session. Zenoh waits for a connection that is being made, for example to a stopped process. After 10 s it
    gives up and raises; that connection then ends with this process."""
    try:
        session.close()  # type: ignore[no-untyped-call]
    except zenoh.ZError as error:
        _log.warning("a connection of the bus is left to the end of this process: %s", text(error))


def _checked_key(key: str) -> str:
    """`key`, if Zenoh can take it: a too long one makes it panic later, a malformed one fails in a thread."""
    if len(key) > MAX_KEY_LENGTH:
        raise LocalError(f"key {key[:40]!r}...: longer than {MAX_KEY_LENGTH} characters")
    try:
        zenoh.KeyExpr(key)
    except zenoh.ZError as error:
        raise LocalError(f"key {key!r}: {text(error)}") from None
    return key


def _checked_endpoint(endpoint: str) -> str:
    if not endpoint.startswith(ENDPOINT_PROTOCOL + "/"):
        raise BusError(f"bus endpoint {endpoint!r}: expected {ENDPOINT_PROTOCOL}/PATH")
    return endpoint


__all__ = ["BINARY", "MSGPACK", "ROUTER", "Bus", "Router", "Subscription", "client_config", "router_config"]
