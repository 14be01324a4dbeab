"""The one door to Zenoh. Every rule here was measured (docs/architecture.md, section Bus).

Publishing never blocks longer than a millisecond and never raises: while the router is away messages are lost, so
whoever needs an answer asks again. Subscribers' callbacks run on Zenoh's own receive thread: they may only enqueue or
do a short step under a lock, since a slow one holds up every other key of the process. The session opens in the
background, waits for a router that is not there yet, and survives its restart.
"""

import json
import logging
import os
import threading
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from swarm.codec import encode
from swarm.errors import BusError
from swarm.paths import MAX_SOCKET_PATH, bus_endpoint

# One worker thread for all of Zenoh's runtimes: 3 threads a client instead of 7, and router CPU for a round trip from
# 305 to 157 us on the measuring machine. Must be set before the library is loaded.
os.environ.setdefault(
    "ZENOH_RUNTIME",
    "(rx:(worker_threads:1),acc:(handover:rx),app:(handover:rx),tx:(handover:rx),net:(handover:rx))",
)

import zenoh

MSGPACK = "application/msgpack"
BINARY = "application/octet-stream"

OnSample = Callable[[str, bytes], None]
OnQuery = Callable[[str, dict[str, str]], bytes | None]

_log = logging.getLogger("bus")
_MAX_MESSAGE = 1024 * 1024


def router_config(endpoint: str) -> str:
    """Zenoh configuration (JSON) of a robot's router: one Unix socket, nothing on the network."""
    return json.dumps(
        {
            "mode": "router",
            "listen": {"endpoints": [endpoint], "exit_on_failure": True},
            "connect": {"endpoints": []},
            "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
            "timestamping": {"enabled": {"router": True, "peer": False, "client": False}},
            "adminspace": {"enabled": True, "permissions": {"read": True, "write": False}},
            "transport": {
                "unicast": {"max_sessions": 64},
                "link": {
                    "protocols": ["unixsock-stream"],
                    "tx": {
                        "lease": 10000,
                        "keep_alive": 4,
                        "queue": {
                            "congestion_control": {
                                "drop": {"wait_before_drop": 1000},
                                "block": {"wait_before_close": 20000},
                            }
                        },
                    },
                    "rx": {"max_message_size": _MAX_MESSAGE},
                },
                "shared_memory": {"enabled": False},
            },
        }
    )


def client_config(endpoint: str) -> str:
    """Zenoh configuration (JSON) of a service: a client of one router, retrying for ever with short periods."""
    return json.dumps(
        {
            "mode": "client",
            "connect": {
                "endpoints": [endpoint],
                "timeout_ms": -1,
                "exit_on_failure": False,
                "retry": {"period_init_ms": 100, "period_max_ms": 500, "period_increase_factor": 2},
            },
            "listen": {"endpoints": []},
            "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
            "queries_default_timeout": 1000,
            "transport": {
                "link": {
                    "protocols": ["unixsock-stream"],
                    "rx": {"max_message_size": _MAX_MESSAGE},
                    "tx": {"queue": {"congestion_control": {"block": {"wait_before_close": 20000}}}},
                },
                "shared_memory": {"enabled": False},
            },
        }
    )


class Router:
    """The Zenoh router of one robot, in this process, until closed. Raises `BusError` where it cannot listen."""

    def __init__(self, endpoint: str) -> None:
        try:
            self._session = zenoh.open(zenoh.Config.from_json5(router_config(endpoint)))
        except zenoh.ZError as error:
            raise BusError(f"the bus cannot listen on {endpoint}: {error}") from None

    def close(self) -> None:
        """Stop routing; the socket file is Zenoh's to remove."""
        self._session.close()


class Bus:
    """A client session of one robot's router.

    Subscriptions, servers and tokens may be declared at once; they take effect when the router is found. Close it
    before the process ends (or use it as a context): an open subscriber would hang the interpreter's exit.
    """

    def __init__(self, endpoint: str, *, on_change: Callable[[bool], None] | None = None) -> None:
        """`endpoint` as of `swarm.paths.bus_endpoint`; `on_change(connected)` is called from Zenoh's thread."""
        self._endpoint = endpoint
        self._on_change = on_change
        self._session: zenoh.Session | None = None
        self._lock = threading.Lock()
        self._pending: list[Callable[[zenoh.Session], object]] = []
        self._kept: list[object] = []
        self._closed = False
        self._connected = threading.Event()
        self._opener = threading.Thread(target=self._open, name="bus-open", daemon=True)
        self._opener.start()

    @classmethod
    def of(cls, directory: Path, *, on_change: Callable[[bool], None] | None = None) -> "Bus":
        """The bus of the robot whose runtime directory is `directory`."""
        return cls(bus_endpoint(directory), on_change=on_change)

    @property
    def connected(self) -> bool:
        """Whether the router is there at this moment."""
        return self._connected.is_set()

    def wait_connected(self, timeout_s: float | None) -> bool:
        """Wait for the router; False when it did not come in time."""
        return self._connected.wait(timeout_s)

    def publish(self, key: str, message: object, *, urgent: bool = False) -> None:
        """Send a message dataclass (as msgpack) or raw bytes; silently lost while the router is away.

        `urgent` puts it ahead of the queue that a flood of other messages fills.
        """
        raw = isinstance(message, bytes | bytearray)
        payload = bytes(message) if isinstance(message, bytes | bytearray) else encode(message)
        session = self._session
        if session is None or self._closed:
            return
        try:
            session.put(
                key,
                payload,
                encoding=BINARY if raw else MSGPACK,
                congestion_control=zenoh.CongestionControl.DROP,
                priority=zenoh.Priority.REAL_TIME if urgent else zenoh.Priority.DATA,
            )
        except zenoh.ZError as error:
            if not self._closed:
                _log.warning("put failed key=%s error=%s", key, error)

    def subscribe(self, keys: str | Iterable[str], callback: OnSample) -> None:
        """Call `callback(key, payload)` for every sample from other sessions. See the module's rule on callbacks."""
        for key in (keys,) if isinstance(keys, str) else keys:
            self._declare(
                lambda session, key=key: session.declare_subscriber(  # type: ignore[misc]
                    key,
                    zenoh.handlers.Callback(_guard(lambda s: callback(str(s.key_expr), s.payload.to_bytes())), indirect=False),
                    allowed_origin=zenoh.Locality.REMOTE,
                )
            )

    def serve(self, key: str, answer: OnQuery) -> None:
        """Answer queries on `key` by `answer(key, parameters)`; None leaves a query unanswered. Same rule on callbacks."""

        def handle(query: zenoh.Query) -> None:
            pairs = (pair.partition("=") for pair in str(query.parameters).split(";") if pair)
            payload = answer(str(query.key_expr), {name: value for name, _, value in pairs})
            if payload is not None:
                query.reply(key, payload, encoding=MSGPACK)

        self._declare(
            lambda session: session.declare_queryable(key, zenoh.handlers.Callback(_guard(handle), indirect=False))
        )

    def ask(self, key: str, on_reply: OnSample, *, timeout_s: float = 1.0, **parameters: object) -> None:
        """Send a query; `on_reply(key, payload)` is called for each answer on Zenoh's thread. No answer, no call."""
        session = self._session
        if session is None or self._closed:
            return
        selector = key + ("?" + ";".join(f"{name}={value}" for name, value in parameters.items()) if parameters else "")

        def handle(reply: zenoh.Reply) -> None:
            if reply.ok is not None:
                on_reply(str(reply.ok.key_expr), reply.ok.payload.to_bytes())

        try:
            session.get(selector, zenoh.handlers.Callback(_guard(handle), indirect=False), timeout=timeout_s)
        except zenoh.ZError as error:
            if not self._closed:
                _log.warning("query failed key=%s error=%s", key, error)

    def announce(self, key: str) -> None:
        """Declare a liveliness token: others see `key` alive until this process ends."""
        self._declare(lambda session: session.liveliness().declare_token(key))

    def watch(self, key: str, callback: Callable[[str, bool], None]) -> None:
        """Call `callback(key, alive)` when tokens matching `key` come and go. A router's restart makes all go: debounce."""

        def handle(sample: zenoh.Sample) -> None:
            callback(str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT)

        self._declare(
            lambda session: session.liveliness().declare_subscriber(
                key, zenoh.handlers.Callback(_guard(handle), indirect=False), history=True
            )
        )

    def close(self) -> None:
        """Undeclare everything and close; safe to call twice and while still waiting for a router."""
        with self._lock:
            self._closed = True
            session, self._session = self._session, None
            self._kept.clear()
        if session is not None:
            session.close()

    def __enter__(self) -> "Bus":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _declare(self, declaration: Callable[[zenoh.Session], object]) -> None:
        with self._lock:
            if self._session is None:
                self._pending.append(declaration)
            else:
                self._kept.append(declaration(self._session))

    def _open(self) -> None:
        """Runs in its own thread: `zenoh.open` waits without end, and a signal could not interrupt it in the main one."""
        try:
            session = zenoh.open(zenoh.Config.from_json5(client_config(self._endpoint)))
        except zenoh.ZError as error:
            _log.error("the bus cannot be opened endpoint=%s error=%s", self._endpoint, error)  # noqa: TRY400
            return
        with self._lock:
            if self._closed:
                session.close()
                return
            self._kept.extend(declaration(session) for declaration in self._pending)
            self._pending.clear()
            self._session = session
            self._kept.append(
                session.info.declare_transport_events_listener(
                    zenoh.handlers.Callback(_guard(self._on_transport), indirect=False), history=True
                )
            )

    def _on_transport(self, event: Any) -> None:
        up = event.kind == zenoh.SampleKind.PUT
        (self._connected.set if up else self._connected.clear)()
        if self._on_change is not None and not self._closed:
            self._on_change(up)


def _guard(callback: Callable[[Any], None]) -> Callable[[Any], None]:
    """Log what a callback raises: inside Zenoh's thread it would vanish or poison the session."""

    def guarded(argument: Any) -> None:
        try:
            callback(argument)
        except Exception:
            _log.exception("a bus callback failed")

    return guarded


__all__ = ["BINARY", "MAX_SOCKET_PATH", "MSGPACK", "Bus", "Router", "client_config", "router_config"]
