"""The shell around all locksteps of one app on one robot: whom a frame is for, and what the mesh says of the links."""

import hashlib
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache, partial
from typing import NamedTuple

from services.apps.core.terms import Terms
from services.apps.equipment.device_claims import DeviceClaims
from services.apps.equipment.measurements import Measurements
from services.apps.host.changes import Changes
from services.apps.host.lockstep_driver import CLOSE_LEAST, CLOSE_WITHIN, LockstepDriver
from services.apps.host.observer import Observer
from services.apps.host.topology import RunPlace, TopologyWatch
from services.apps.persistence.storage import Storage
from services.apps.runner import Runner
from swarm.core.epochs.actions import EpochRequest
from swarm.core.lockstep.actions import address_of
from swarm.core.lockstep.frames import Channel
from swarm.errors import FrameError
from swarm.messages import Links, SetAppEpoch, Topology
from swarm.messages.codec import Value
from swarm.messages.keys import key
from swarm.process.runtime import Runtime, listen, refuse

MOST_KEYS = 1024
"""Keys of frames that are remembered, so that each is taken apart once."""


class Part(NamedTuple):
    """One lockstep of an app."""

    channel: str
    """Its name within the app; empty for an app that is one lockstep."""
    runner: Runner
    measurements: Measurements | None = None
    """The source of the app's measurements, if the app wants some."""


class _Sender(NamedTuple):
    """The parts of a frame's key."""

    driver: LockstepDriver
    robot: str
    channel: Channel | None
    """None for a note about the members."""
    around: bool
    """Whether the frame has not come over the link with its sender."""


class LockstepHost:
    """The locksteps of one app on one robot: from their first states, or the snapshots of an earlier process, to the
    last iteration."""

    def __init__(
        self,
        runtime: Runtime,
        app: str,
        parts: Sequence[Part],
        place: RunPlace,
        storage: Storage,
        observer: Observer | None,
        *,
        links_change: bool = True,
        whole: bool = True,
    ) -> None:
        """`links_change`: whether the mesh may put other links in force meanwhile. `whole`: whether these locksteps are
        the whole app; those of an event-driven app are not. Raises `LocalError` where their files cannot be had."""
        self.app = app
        self.robot = runtime.robot
        self.drivers: dict[str, LockstepDriver] = {}
        """The drivers by the name of the channel."""
        self._runtime = runtime
        self._run = place.run
        self._by_schema: dict[int, LockstepDriver] = {}
        self._by_notes: dict[str, LockstepDriver] = {}
        self._sender = lru_cache(MOST_KEYS)(self._parse_key)
        self._names = place.names
        self._connections: dict[str, int] = {}
        self._orders: deque[str] = deque(maxlen=100)
        self._ready = False
        self._whole = whole
        self._claims: DeviceClaims | None = None
        run, options = place.run, place.options
        neighbours = place.graph.neighbours(self.robot)
        for channel, runner, measurements in parts:
            schema = schema_of(runner, channel, place.digest)
            terms = Terms(run, schema, options.last, options.rule, options.drop, options.after)
            watch = TopologyWatch(neighbours, partial(runtime.log.warning, "%s"))
            driver = LockstepDriver(
                *(runtime, app, channel, runner, terms, place, storage, watch, measurements, observer, self._changed)
            )
            self.drivers[channel] = self._by_schema[schema] = self._by_notes[terms.notes] = driver
        if whole:
            runner = parts[0].runner
            self._let_change(runner, run, storage, observer)
            if runner.app.robot.devices is not None:
                self._claims = DeviceClaims(runtime, runner.app.robot.devices, lambda: not self.failed, self._is_idle)
        # Of neighbours, and of another process of this app on this robot: there must not be one.
        runtime.bus.subscribe(key("*", f"app/{app}", "sync", "**"), self._on_sync)
        listen(runtime, key(self.robot, f"app/{app}", "set", "epoch"), SetAppEpoch, self._on_order)
        listen(runtime, key(self.robot, "mesh", "links"), Links, self._on_links)
        if links_change:
            listen(runtime, key(self.robot, "mesh", "topology"), Topology, self._on_topology)

    @property
    def failed(self) -> bool:
        """Whether a lockstep has stopped for a fault."""
        return any(driver.failed for driver in self.drivers.values())

    @property
    def faults(self) -> dict[str, str]:
        """Why locksteps have stopped, by the name of the channel."""
        return {channel: driver.run.reason for channel, driver in self.drivers.items() if driver.failed}

    @property
    def obstacles(self) -> dict[str, str]:
        """Why locksteps do not go on, as far as membership is the reason, by the name of the channel."""
        return {channel: driver.run.obstacle for channel, driver in self.drivers.items() if driver.run.obstacle}

    def start(self) -> None:
        for driver in self.drivers.values():
            driver.start()

    def change(self, channel: str, changed: Callable[[], None], values: Mapping[str, Value]) -> None:
        """Other values for live parameters of a channel, from its next step on; then `changed()` is called."""
        self.drivers[channel].change(changed, values)

    def nudge(self) -> None:
        """The bus or a link came up: ask now for what is missing."""
        for driver in self.drivers.values():
            driver.nudge()

    def close(self, within: float = CLOSE_WITHIN) -> None:
        """Let go of the files. Steps that run are waited for, all together for `within` s, since systemd waits for
        5 s."""
        if self._claims is not None:
            self._claims.close()
        until = self._runtime.now + within
        for driver in self.drivers.values():
            driver.close(max(CLOSE_LEAST, until - self._runtime.now))

    def _let_change(self, runner: Runner, run: int, storage: Storage, observer: Observer | None) -> None:
        """Take other parameters while it runs, as far as the app has declared some that are live."""
        record = None if observer is None else partial(observer.parameters, self.robot)
        path = storage.parameters(self.app)
        changes = Changes(self._runtime, self.app, runner.app, runner.change, path, run, record)
        runner.change(changes.kept())
        runner.changed = changes.tell
        changes.tell()

    def _is_idle(self) -> bool:
        return all(driver.idle for driver in self.drivers.values())

    def _changed(self) -> None:
        """Look anew at the locksteps after one has begun, has changed its epoch, or has ended."""
        self._sender.cache_clear()
        for driver in self.drivers.values():
            driver.watch.forget()
        if self._claims is not None:
            self._claims.look()
        begun = all(driver.run.begun for driver in self.drivers.values())
        if self._whole and begun and not self._ready and not self.failed:
            self._ready = True
            self._runtime.ready()

    # What the bus brings

    def _on_sync(self, name: str, payload: bytes) -> None:
        """Give a frame to the lockstep that it is for."""
        sender = self._sender(name)
        if sender is None:
            return
        driver, robot, channel, around = sender
        if channel is not None:
            driver.run.receive(robot, channel, payload, self._runtime.now, around=around)
            driver.perform_soon()
        elif robot != self.robot:
            driver.receive_note(robot, payload)

    def _parse_key(self, name: str) -> _Sender | None:
        """Parse the key of a frame; None where the frame is for another robot, run or app."""
        address = address_of(name)
        if address is None:
            refuse(self._runtime, f"{name}: not the key of a frame", "refused_keys")
            return None
        robot, _, text, to, around = address
        if robot not in self._names:  # whoever is remembered as heard is a robot of the configuration
            refuse(self._runtime, f"{name}: its sender is not in the configuration", "refused_keys")
            return None
        if to is not None and to != self.robot:
            return None
        if text in self._by_notes:
            return _Sender(self._by_notes[text], robot, None, around=False)
        try:
            channel = Channel.parse(text)
        except FrameError as error:
            refuse(self._runtime, f"{name}: {error}", "refused_keys")
            return None
        driver = self._by_schema.get(channel.schema) if channel.run == self._run else None
        for each in self.drivers.values() if driver is None else (driver,):
            if robot != self.robot:
                each.watch.heard(robot, channel, each.run.channel)
        if driver is None:
            self._runtime.counters["sync_other_run" if channel.run != self._run else "sync_other_version"] += 1
            return None
        return _Sender(driver, robot, channel, around)

    def _on_links(self, links: Links) -> None:
        up = {link.peer: link.connection for link in links.links if link.state == "up" and link.peer in self._names}
        # The median: after a cut the smoothed one is for seconds as long as the cut was.
        rtts = [link.rtt_median for link in links.links if link.rtt_median is not None]
        renewed = any(self._connections.get(peer) != connection for peer, connection in up.items())
        self._connections.update(up)
        for driver in self.drivers.values():
            if rtts:
                driver.run.rtt = max(rtts)
            if renewed:
                driver.nudge()

    def _on_order(self, order: SetAppEpoch) -> None:
        if order.ticket not in self._orders:
            self._orders.append(order.ticket)
            for driver in self.drivers.values():
                driver.request(EpochRequest(order.drop, order.add, order.force))

    def _on_topology(self, in_force: Topology) -> None:
        for driver in self.drivers.values():
            driver.watch.take(in_force)
            driver.run.epochs.take_links(in_force.edges)


def schema_of(runner: Runner, channel: str, digest: bytes) -> int:
    """32 bits over the app's source, the state's declaration and the channel's name: two locksteps that differ in one
    of them never take each other's values."""
    text = digest + runner.schema.hash.to_bytes(4, "little") + channel.encode()
    return int.from_bytes(hashlib.blake2b(text, digest_size=4).digest(), "little")
