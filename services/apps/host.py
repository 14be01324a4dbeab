"""The process around one app: bus, files and clock for the lockstep core and the app's step.

Threads. Zenoh's thread feeds the core and may send what that gives, but never runs a step: an author's step
may take its time, and a blocked callback would hold up every key of the process. One worker runs the steps. A
ticker runs the core's timers and publishes state and progress. One lock is around the core; another, taken
first, around the app, so that results are only looked at between steps.
"""

import queue
import struct
import threading
from collections.abc import Callable

from services.apps import topology
from services.apps.claim import Claim
from services.apps.measurements import Measurements
from services.apps.recorder import Recorder
from services.apps.runner import Runner
from services.apps.snapshot import SnapshotFile
from swarm import clock
from swarm.codec import decode, encode
from swarm.core.lockstep import (
    Action,
    Advanced,
    Channel,
    Compute,
    Fault,
    Finished,
    Lockstep,
    Save,
    Send,
    Waiting,
)
from swarm.core.lockstep_frames import Snapshot
from swarm.errors import AppError, FrameError, PayloadError, SwarmError
from swarm.keys import key
from swarm.messages import AppProgress, AppState, Links, Measurement, Topology
from swarm.service import Service

TICK = 0.1
"""s between two looks of the ticker: state goes out at 10 Hz at most, for people and programs that watch. The
lockstep's timers are never late for it: when set they are at least as far away (`WANT_AFTER`). At 25 Hz the ticker and
what it published took a fifth of the app's CPU time."""
EVERY = 1.0
"""s between two messages of progress and state when nothing changes; a measurement that late is given as a
reason."""
ALONE = 0.03
"""s of an iteration of a robot without neighbours, who has nobody to wait for."""
CLOSE_WITHIN = 2.0
"""s that a running step has when the process is to end."""
STUCK = 10.0
"""s after which a step that still runs no longer feeds systemd's watchdog."""
_STAMP = struct.Struct("<d")  # before the private fields in a snapshot: when its state was computed


class Host:
    """One app on one robot: from the first state, or the snapshot of an earlier process, to the last
    iteration."""

    def __init__(
        self,
        service: Service,
        name: str,
        runner: Runner,
        run: int,
        links: topology.Links,
        measurements: Measurements | None,
        last: int | None,
        record: Callable[[bool], Recorder] | None,
    ) -> None:
        """`record` makes the recording, and is told whether to go on with an earlier one. Raises `LocalError` where
        lock or snapshot cannot be had."""
        self._service = service
        self._name = name
        self._runner = runner
        self._record = record
        self._claim = Claim(service.runtime, name)
        self._snapshots = SnapshotFile(service.runtime / f"app.{name}.snapshot")
        if not links.kept:
            topology.save(service.runtime, name, run, links)
        self._channel = Channel(run, links.epoch, self._claim.incarnation, runner.schema.hash)
        self._sync = key(service.robot, f"app/{name}", "sync", self._channel.text)
        neighbours = links.neighbours(service.robot)
        self._core = Lockstep(service.robot, neighbours, self._channel, runner.schema.size, last=last)
        self._measurements = measurements
        self._recorder: Recorder | None = None
        self._lock = threading.Lock()
        self._app_lock = threading.Lock()
        self._todo: queue.SimpleQueue[Compute | None] = queue.SimpleQueue()
        self._closing = False
        self._computed_at = 0.0
        self._step_began: float | None = None
        self._waiting: tuple[str, ...] = ()
        self._measuring: float | None = None
        self._phase, self._reason = "starting", ""
        self._muted = False
        self._state: AppState | None = None
        self._connections: dict[str, int] = {}
        self._watch = topology.Watch(links, service.robot, lambda text: service.log.warning("%s", text))
        for peer in (service.robot, *neighbours):
            service.bus.subscribe(key(peer, f"app/{name}", "sync", "**"), self._on_sync)
        service.bus.subscribe(key(service.robot, "mesh", "links"), self._on_links)
        service.bus.subscribe(key(service.robot, "mesh", "topology"), self._on_topology)
        service.bus.serve(key(service.robot, f"app/{name}", "state"), self._answer)
        service.bus.serve(key(service.robot, f"app/{name}", "progress"), lambda *_: encode(self._progress()))
        # Daemons: a step that never returns must not keep the process from ending.
        self._threads = [
            threading.Thread(target=self._guarded, args=(loop,), name=loop.__name__.strip("_"), daemon=True)
            for loop in (self._worker, self._ticker)
        ]
        for thread in self._threads:
            thread.start()

    @property
    def failed(self) -> bool:
        """Whether the app has stopped for a fault."""
        return self._phase == "fault"

    def nudge(self) -> None:
        """The bus or a link came up: ask now for what is missing."""
        with self._lock:
            if self._core.k >= 0:
                self._core.nudge(clock.now())
                self._core.handle_timer(clock.now())
                self._perform()

    def close(self) -> None:
        """End the threads and let go of the files. A step that runs is waited for, but not for ever."""
        self._closing = True
        self._todo.put(None)
        if self._measurements is not None:
            self._measurements.close()
        for thread in self._threads:
            thread.join(CLOSE_WITHIN)
            if thread.is_alive():
                self._service.log.warning("the step of iteration %d does not end", self._core.k)
                if self._recorder is not None:
                    self._recorder.flush()
                return
        if self._recorder is not None:
            self._recorder.close()
        self._snapshots.close()
        self._claim.close()

    # On Zenoh's thread

    def _on_sync(self, name: str, payload: bytes) -> None:
        """A frame: `swarm/<sender>/app/<app>/sync/<channel>`, with `/<receiver>` behind it when it is for one
        robot."""
        _, sender, _, _, _, channel, *receiver = name.split("/")
        if receiver and receiver != [self._service.robot]:
            return
        try:
            parsed = Channel.parse(channel)
        except FrameError as error:
            self._service.counters["refused_keys"] += 1
            self._service.log.debug("%s: %s", name, error)
            return
        with self._lock:
            if parsed.run == self._channel.run and sender != self._service.robot:
                self._watch.heard(sender, same=parsed.epoch == self._channel.epoch)
            if self._core.k >= 0:  # before the own start there is no slot: the sender is asked again
                self._core.receive(sender, parsed, payload, clock.now())
                self._perform()

    def _on_links(self, name: str, payload: bytes) -> None:
        try:
            links = decode(Links, payload, name).links
        except PayloadError as error:
            self._service.counters["refused_payloads"] += 1
            self._service.log.debug("%s", error)
            return
        up = {link.peer: link.connection for link in links if link.state == "up"}
        rtts = [link.rtt for link in links if link.rtt is not None]
        if rtts:
            self._core.rtt = max(rtts)
        renewed = any(self._connections.get(peer) != connection for peer, connection in up.items())
        self._connections.update(up)
        if renewed:
            self.nudge()

    def _on_topology(self, name: str, payload: bytes) -> None:
        try:
            in_force = decode(Topology, payload, name)
        except PayloadError as error:
            self._service.counters["refused_payloads"] += 1
            self._service.log.debug("%s", error)
            return
        with self._lock:
            self._watch.take(in_force)

    # On the worker's thread

    def _worker(self) -> None:
        if not self._begin():
            return
        while (todo := self._todo.get()) is not None:
            if not todo.values:
                self._service.stopping.wait(ALONE)
            measurement = self._measure(todo.k)
            if self._closing or self._phase == "fault":
                return
            with self._app_lock:
                self._step_began = clock.now()
                own, private = self._runner.step(todo.k, todo.own, todo.values, measurement)
                now = self._computed_at = clock.now()
                self._step_began = None
                with self._lock:
                    self._core.computed(own, _STAMP.pack(now) + private, now)
                    self._perform()

    def _begin(self) -> bool:
        """Go on from a snapshot of this run, or begin it; False when told to stop before there was a
        measurement."""
        saved = self._saved()
        if self._record is not None:
            self._recorder = self._record(saved is not None)
        measurement = self._measure(0) if saved is None else None
        if self._closing:
            return False
        with self._app_lock, self._lock:
            now = clock.now()
            self._phase = "running"
            if saved is not None:
                private = self._core.resume(saved.encode(), now)
                (self._computed_at,) = _STAMP.unpack_from(private)
                self._runner.restore(saved.k, saved.value, private[_STAMP.size :])
                self._service.log.info("goes on at iteration %d", saved.k)
            else:
                own, private = self._runner.start(measurement)
                self._computed_at = now
                self._core.start(own, now, _STAMP.pack(now) + private)
            self._perform()
        if not self.failed:
            self._service.ready()
        return True

    def _measure(self, k: int) -> Measurement | None:
        """The measurement for step k where the app wants one; waits for it."""
        if self._measurements is None:
            return None
        self._measuring = clock.now()
        measurement = self._measurements.get(k)
        self._measuring = None
        return measurement

    def _saved(self) -> Snapshot | None:
        data = self._snapshots.read()
        if data is None:
            return None
        snapshot = Snapshot.decode(data)
        if snapshot.run == self._channel.run:
            return snapshot
        self._service.log.info("the snapshot is of another run (%016x), this one begins anew", snapshot.run)
        return None

    # On the ticker's thread

    def _ticker(self) -> None:
        told: tuple[object, ...] = ()
        told_at = 0.0
        while not self._service.stopping.wait(self._pause()):
            now = clock.now()
            with self._lock:
                deadline = self._core.next_deadline()
                if deadline is not None and now >= deadline:
                    self._core.handle_timer(now)
                    self._perform()
                news = self._report(now)
            repeat = now - told_at >= EVERY
            if repeat:
                for name, count in self._core.counters.copy().items():
                    self._service.counters[f"sync_{name.replace(' ', '_')}"] = count
            self._show(repeat)
            changed = news != told
            if repeat or changed:
                told, told_at = news, now
                # Waiting for others is no fault of ours; a step that does not end is.
                if self._step_began is None or now - self._step_began < STUCK:
                    self._service.watchdog()
                progress = self._progress()
                if self._recorder is not None and changed:
                    self._recorder.progress(progress)
                    if progress.phase in ("done", "fault"):
                        self._recorder.flush()  # whoever hears of the end finds it recorded
                self._publish("progress", progress)

    def _pause(self) -> float:
        with self._lock:
            deadline = self._core.next_deadline()
        return TICK if deadline is None else min(TICK, max(0.0, deadline - clock.now()))

    def _show(self, repeat: bool) -> None:
        """Publish the state if it is new and no step is running (else the next look will find it)."""
        state = self._state
        if self._phase not in ("running", "done") or (state is not None and state.k == self._core.k and not repeat):
            return
        if self._app_lock.acquire(blocking=False):
            runner = self._runner
            try:
                state = AppState(self._computed_at, runner.k, runner.state(), runner.result())
            except AppError as error:
                with self._lock:
                    self._fail(str(error))
                return
            finally:
                self._app_lock.release()
            self._state = state
            self._publish("state", state)

    def _report(self, now: float) -> tuple[str, tuple[str, ...], str]:
        """Phase, robots waited for, reason."""
        measuring = self._measuring
        if self._phase in ("starting", "running") and measuring is not None and now - measuring >= EVERY:
            return "waiting", (), "the dwm service gives no measurement"
        if self._phase == "running" and self._waiting:
            return "waiting", self._waiting, self._watch.reason(self._waiting)
        return self._phase, (), self._reason

    def _progress(self) -> AppProgress:
        now = clock.now()
        phase, peers, reason = self._report(now)
        return AppProgress(now, phase, max(self._core.k, 0), peers, reason)

    def _answer(self, *_: object) -> bytes | None:
        state = self._state
        return None if state is None else encode(state)

    # Everywhere, with the lock held

    def _perform(self) -> None:
        """Carry out what the core wants, in its order."""
        for action in self._core.actions():
            if not self._muted:
                self._do(action)

    def _do(self, action: Action) -> None:
        match action:
            case Save(data):
                try:
                    self._snapshots.write(data)
                except SwarmError as error:
                    # What was not written must never be sent (R5): the neighbours keep what they had of us.
                    self._muted = True
                    self._fail(str(error))
            case Send(data, to):
                self._service.bus.publish(self._sync if to is None else f"{self._sync}/{to}", data, urgent=True)
            case Advanced(k, _):
                if self._recorder is not None:
                    self._recorder.state(k, self._computed_at, self._runner.state(), self._runner.result())
            case Compute():
                self._todo.put(action)
            case Waiting(_, peers):
                self._waiting = peers
            case Fault(reason):
                self._fail(reason)
            case Finished():
                self._phase = "done"

    def _fail(self, reason: str) -> None:
        """Stop computing, say why, and stay: neighbours still get answers, and the reason can be read."""
        if self._phase != "fault":
            self._phase, self._reason = "fault", reason
            self._service.log.error("%s", reason)
            self._service.degraded(reason)

    def _publish(self, topic: str, message: object) -> None:
        self._service.bus.publish(key(self._service.robot, f"app/{self._name}", topic), message)

    def _guarded(self, loop: Callable[[], None]) -> None:
        """Run a thread's loop; what it raises is a fault of the app, our own mistakes included."""
        try:
            loop()
        except SwarmError as error:
            with self._lock:
                self._fail(str(error))
        except Exception as error:
            self._service.log.exception("the app host has a fault of its own")
            with self._lock:
                self._fail(f"fault of the app host: {error!r}")
