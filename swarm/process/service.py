"""Life cycle of a service process: starting, ready, degraded, stopping.

    starting --ready()--> ready <--degraded(reason)/ready()--> degraded
        any --SIGTERM, SIGINT or stop()--> stopping

State goes to systemd (sd_notify), to the bus (`swarm/<robot>/<service>/status`, published on change and
answered to queries) and to a liveliness token `swarm/<robot>/<service>/alive`. A service of a simulation dies
with its parent.
"""

import os
import signal
import threading
from collections import Counter
from collections.abc import Callable
from pathlib import Path

from swarm import clock
from swarm.bus import zenoh_runtime
from swarm.bus.zenoh_bus import Bus
from swarm.config import Config, load, who_am_i
from swarm.messages import Status
from swarm.messages.codec import encode
from swarm.messages.keys import key
from swarm.process import log
from swarm.process.edges import die_with_parent, end_on_defects, notify, run
from swarm.process.paths import runtime_dir
from swarm.process.text import printable

__all__ = ["Service", "die_with_parent", "notify", "run"]

FEED_S = 0.5
"""Seconds between two messages to systemd's watchdog at least: the shortest time that a unit is given is 3 s."""

_STOP_SIGNALS = (signal.SIGTERM, signal.SIGINT)


class Service:
    """The parts of every service process: config, own name, bus, log, state, counters, and the wish to stop.

    `stopping` is set by SIGTERM, SIGINT or `stop()`; main threads wait on it.
    """

    def __init__(self, name: str, *, on_bus: Callable[[bool], None] | None = None, direct: bool = False) -> None:
        """Reads the config and who we are; raises `ConfigError`.

        `on_bus(connected)` runs on Zenoh's thread, possibly before this returns; where it needs the finished
        service, use `bus.on_change` afterwards. `direct`: other such services reach this one without the router.
        """
        die_with_parent()
        self.name = name
        self.log = log.setup(name)
        self.config: Config = load()
        self.robot: str = who_am_i(self.config)
        self.runtime: Path = runtime_dir()
        self.stopping = threading.Event()
        self._lock = threading.Lock()
        self._state, self._reason, self._since = "starting", "", clock.now()
        self._fed_at = float("-inf")
        self._watch_signals()
        self._status_key = key(self.robot, name, "status")
        self.bus = Bus.of(self.runtime, name if direct else None)
        self.counters: Counter[str] = self.bus.counters
        self.bus.announce(key(self.robot, name, "alive"))
        self.bus.serve(self._status_key, lambda *_: encode(self.status()))
        self.bus.on_change(self._bus_changed)
        if on_bus is not None:
            self.bus.on_change(on_bus)

    def waits(self, reason: str) -> None:
        """Say what the service waits for until it is ready for the first time."""
        if self._state == "starting":
            self._change("starting", reason)

    def ready(self) -> None:
        """Say that the service does its work."""
        self._change("ready", "")

    def degraded(self, reason: str) -> None:
        """Say that it runs but cannot do all of its work, and why."""
        self._change("degraded", reason)

    def stop(self) -> None:
        """Wish the service to end; its main thread sees `stopping`."""
        # Callbacks that come while files and sockets are being closed may fail by that.
        end_on_defects(False)
        self.stopping.set()

    def watchdog(self) -> None:
        """Tell systemd of real progress, at most each `FEED_S`; call it where work was done, not from a timer. It waits
        for nobody: who calls it may hold a lock, or be the thread of the bus."""
        now = clock.now()
        if now >= self._fed_at + FEED_S:
            self._fed_at = now
            notify("WATCHDOG=1", timeout_s=0.0)

    def status(self) -> Status:
        """Return the state as it is now."""
        with self._lock:
            state, reason, since = self._state, self._reason, self._since
        # The copy is one step of the interpreter: other threads may be counting a new name.
        counters = {name: count for name, count in {**zenoh_runtime.counters, **self.counters}.items() if count}
        return Status(clock.now(), self.name, state, reason, os.getpid(), since, counters)

    def close(self) -> None:
        """Announce the end and leave the bus. Only the main thread may call it."""
        self._change("stopping", "")
        self.bus.close()
        # As it ends, Python gives signals that have a handler back to the kernel. The next one would kill the process,
        # and its exit code would tell of that signal, not of its work.
        for number in _STOP_SIGNALS:
            signal.signal(number, signal.SIG_IGN)

    def __enter__(self) -> "Service":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _watch_signals(self) -> None:
        """Let SIGTERM and SIGINT set `stopping`, whichever thread they hit and whatever that thread is doing.

        The kernel may deliver a signal to one of Zenoh's threads. Python's own handlers run when the main thread next
        executes bytecode, and that one sleeps in `stopping.wait()`: one stop in thirty was lost. The wake-up pipe is
        written by the thread that was hit, and read by one that holds no lock the event needs.
        """
        reader, writer = os.pipe()
        os.set_blocking(writer, False)
        signal.set_wakeup_fd(writer, warn_on_full_buffer=False)
        for number in _STOP_SIGNALS:
            signal.signal(number, lambda *_: None)

        def watch() -> None:
            while (number := os.read(reader, 1)) and number[0] not in _STOP_SIGNALS:
                pass
            self.stop()

        threading.Thread(target=watch, name="signals", daemon=True).start()

    def _change(self, state: str, reason: str) -> None:
        with self._lock:
            if self._state == "stopping" or (state, reason) == (self._state, self._reason):
                return
            self._state, self._reason, self._since = state, reason, clock.now()
        if state == "degraded":
            self.log.warning("degraded: %s", reason)
        first = {"ready": "READY=1\n", "stopping": "STOPPING=1\n"}.get(state, "")
        notify(first + "STATUS=" + printable(f"{state} {reason}".strip()))
        self.bus.publish(self._status_key, self.status())

    def _bus_changed(self, connected: bool) -> None:
        self.log.debug("bus connected=%s", connected)
        if connected:
            self.bus.publish(self._status_key, self.status())
