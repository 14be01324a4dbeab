"""The process around one app: one bus, one ticker and one lock file for all its lockstep channels.

Threads. Each strand has a worker thread for its steps, so that a slow channel holds up no other. Zenoh's thread feeds
the strands and may send what that gives, but it never runs a step: an author's step may take its time, and a blocked
callback would hold up every key of the process. A ticker thread runs the timers and publishes states and progress.
"""

import hashlib
import threading
from collections import deque
from collections.abc import Callable, Mapping, Sequence

from services.apps import topology
from services.apps.changes import Changes
from services.apps.claim import Claim
from services.apps.core.terms import Terms
from services.apps.device_claims import DeviceClaims
from services.apps.measurements import Measurements
from services.apps.recorder import Recorder
from services.apps.runner import Runner
from services.apps.worker import CLOSE_WITHIN, Latest, Worker
from swarm import clock
from swarm.app.run_options import RunOptions
from swarm.app.sync_app import SyncApp
from swarm.core.lockstep import WANT_AFTER, Channel
from swarm.core.lockstep_actions import address_of
from swarm.errors import FrameError, PayloadError
from swarm.frozen import frozen
from swarm.messages import Links, SetAppEpoch, Topology
from swarm.messages.codec import Value, decode
from swarm.messages.keys import key
from swarm.process.service import Service

TICK = 0.1
"""s between two looks of the ticker while there is something to see: state goes out at 10 Hz at most, for people and
programs that watch. At 25 Hz the ticker and what it published took a fifth of the app's CPU time."""

SELDOM = WANT_AFTER
"""s between two looks while nobody hears the states. The lockstep's timers are never late for it: they are set to at
least as far away, or by a look itself, or the ticker is woken (`nudge`)."""


@frozen
class Part:
    """One lockstep of an app."""

    channel: str
    """Its name within the app; empty for an app that is one lockstep."""
    app: SyncApp
    measurements: Measurements | None = None
    """Where the app's measurements come from, if it wants some."""


class Host:
    """The lockstep channels of one app on one robot: from their first states, or the snapshots of an earlier process,
    to the last iteration."""

    def __init__(
        self,
        service: Service,
        name: str,
        parts: Sequence[Part],
        code: tuple[str, bytes],
        run: int,
        links: topology.Links,
        run_options: RunOptions,
        recorder: Recorder | None,
        claim: Claim | None = None,
    ) -> None:
        """`code`: path and digest of the app's source. `run_options`: when the run ends, and what it does about absent
        robots. `claim`: the app's lock where somebody else holds it, for the
        channels of an event-driven app. Raises `LocalError` where lock or snapshots cannot be had."""
        self._service = service
        self._run = run
        source, digest = code
        self._own_claim = Claim(service.runtime, name) if claim is None else None
        held = claim or self._own_claim
        assert held is not None
        if not links.kept:
            topology.save(service.runtime, name, run, links)
        self._closing = False
        self._hurry = threading.Event()
        self._connections: dict[str, int] = {}
        self._workers: dict[str, Worker] = {}
        self._by_schema: dict[int, Worker] = {}
        self._notes: dict[str, Worker] = {}
        self._orders: deque[str] = deque(maxlen=100)
        for part in parts:
            runner = Runner(part.app, source, run_options.tolerance)
            schema = schema_of(runner, part.channel, digest)
            terms = Terms(run, schema, run_options.last, run_options.rule, run_options.drop, run_options.after)
            birth, measurements = held.incarnation, part.measurements
            worker = Worker(service, name, part.channel, runner, terms, birth, links, measurements, recorder)
            self._notes[terms.notes] = worker
            if not part.channel:
                self._let_change(name, runner, run, recorder)
            self._workers[part.channel] = self._by_schema[schema] = worker
        # Of neighbours, and of another process of this app on this robot: there must not be one.
        service.bus.subscribe(key("*", f"app/{name}", "sync", "**"), self._on_sync)
        service.bus.subscribe(key(service.robot, f"app/{name}", "set", "epoch"), self._on_order)
        service.bus.subscribe(key(service.robot, "mesh", "links"), self._on_links)
        service.bus.subscribe(key(service.robot, "mesh", "topology"), self._on_topology)
        self._device_claims = DeviceClaims(parts[0].app.robot.devices if claim is None else None)
        self._ticks = threading.Thread(target=self._ticker, name="ticker", daemon=True)
        for worker in self._workers.values():
            worker.start()
        self._ticks.start()

    @property
    def failed(self) -> bool:
        """Whether a channel has stopped for a fault."""
        return any(worker.failed for worker in self._workers.values())

    @property
    def faults(self) -> dict[str, str]:
        """Why channels have stopped, by name."""
        return {channel: worker.reason for channel, worker in self._workers.items() if worker.failed}

    def latest(self, channel: str) -> Latest | None:
        """The newest state of a channel, whole; None before the first one."""
        return self._workers[channel].latest

    def change(self, channel: str, changed: Callable[[], None], values: Mapping[str, Value]) -> None:
        """Other values for live parameters of a channel, from its next step on; then `changed()` is called."""
        self._workers[channel].change(changed, values)

    def nudge(self) -> None:
        """The bus or a link came up: ask now for what is missing."""
        for worker in self._workers.values():
            worker.nudge()
        self._hurry.set()

    def close(self) -> None:
        """End the threads and let go of the files. A step that runs is waited for, but not for ever."""
        for worker in self._workers.values():
            worker.stop()
        self._closing = True
        self._hurry.set()
        self._ticks.join(CLOSE_WITHIN)
        closed = [worker.close() for worker in self._workers.values()]
        self._device_claims.close()
        if all(closed) and self._own_claim is not None:
            self._own_claim.close()

    # On Zenoh's thread

    def _on_sync(self, name: str, payload: bytes) -> None:
        """Give a frame to the worker that it is for."""
        if (address := address_of(name)) is None:
            self._refuse_key(name, "not the key of a frame")
            return
        sender, _, text, to, around = address
        if to is not None and to != self._service.robot:
            return
        if (told := self._notes.get(text)) is not None:
            if sender != self._service.robot:
                told.receive_note(sender, payload)
            return
        try:
            channel = Channel.parse(text)
        except FrameError as error:
            self._refuse_key(name, str(error))
            return
        worker = self._by_schema.get(channel.schema)
        if worker is not None and channel.run == self._run:
            worker.receive(sender, channel, payload, around=around)
            return
        self._service.counters["sync_other_run" if channel.run != self._run else "sync_other_version"] += 1
        for worker in self._workers.values():
            worker.stranger(sender, channel)

    def _on_links(self, name: str, payload: bytes) -> None:
        try:
            links = decode(Links, payload, name).links
        except PayloadError as error:
            self._refuse(error)
            return
        up = {link.peer: link.connection for link in links if link.state == "up"}
        # The median: after a cut the smoothed one is for seconds as long as the cut was.
        rtts = [link.rtt_median for link in links if link.rtt_median is not None]
        renewed = any(self._connections.get(peer) != connection for peer, connection in up.items())
        self._connections.update(up)
        for worker in self._workers.values():
            if rtts:
                worker.take_rtt(max(rtts))
        if renewed:
            self.nudge()

    def _on_order(self, name: str, payload: bytes) -> None:
        try:
            order = decode(SetAppEpoch, payload, name)
        except PayloadError as error:
            self._refuse(error)
            return
        if order.ticket not in self._orders:
            self._orders.append(order.ticket)
            for worker in self._workers.values():
                worker.order(order)

    def _on_topology(self, name: str, payload: bytes) -> None:
        try:
            in_force = decode(Topology, payload, name)
        except PayloadError as error:
            self._refuse(error)
            return
        for worker in self._workers.values():
            worker.take(in_force)

    def _let_change(self, name: str, runner: Runner, run: int, recorder: Recorder | None) -> None:
        """Take other parameters while it runs, as far as the app has declared some that are live."""
        service = self._service
        kept = (service.runtime / f"app.{name}.parameters", run)
        record = None if recorder is None else recorder.parameters
        bus, robot, change = service.bus, service.robot, runner.change
        changes = Changes(bus, robot, name, runner.app, change, self._refuse, kept=kept, record=record)
        change(changes.kept())
        runner.changed = changes.tell
        changes.tell()

    def _refuse_key(self, name: str, reason: str) -> None:
        self._service.counters["refused_keys"] += 1
        self._service.log.debug("%s: %s", name, reason)

    def _refuse(self, error: PayloadError) -> None:
        self._service.counters["refused_payloads"] += 1
        self._service.log.debug("%s", error)

    # On the ticker's thread

    def _ticker(self) -> None:
        told_ready = False
        workers = tuple(self._workers.values())
        while True:
            self._hurry.wait(self._pause(SELDOM if told_ready else TICK))
            self._hurry.clear()
            if self._closing or self._service.stopping.is_set():
                return
            news = [worker.tick() for worker in workers]
            self._device_claims.look(well=not self.failed and not any(worker.stuck for worker in workers))
            if not told_ready and all(worker.begun for worker in workers) and not self.failed:
                told_ready = True
                self._service.ready()
            if any(news) and not any(worker.stuck for worker in workers):
                self._service.watchdog()

    def _pause(self, longest: float) -> float:
        workers = self._workers.values()
        if any(worker.watched or worker.busy for worker in workers):
            longest = TICK
        deadlines = [worker.next_deadline() for worker in workers]
        first = min((deadline for deadline in deadlines if deadline is not None), default=None)
        return longest if first is None else min(longest, max(0.0, first - clock.now()))


def schema_of(runner: Runner, channel: str, digest: bytes) -> int:
    """32 bits over the app's source, the state's declaration and the channel's name: two strands that differ in one of
    them never take each other's values."""
    text = digest + runner.schema.hash.to_bytes(4, "little") + channel.encode()
    return int.from_bytes(hashlib.blake2b(text, digest_size=4).digest(), "little")
