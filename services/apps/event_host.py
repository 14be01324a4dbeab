"""The process around one event-driven or periodic app: bus, clock and threads for the core and the app's handlers.

Threads. Zenoh's thread feeds the core, but never runs a handler: an author's code may take its time. One worker runs
the handlers. A ticker runs the core's timers, claims the devices that the app has taken, and publishes state and
progress. One lock is around the core; another, taken first, around the app, so that its state is only looked at between
handlers.
"""

import math
import queue
import threading
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial

from services.apps import topology
from services.apps.changes import Changes
from services.apps.claim import Claim
from services.apps.device_claims import DeviceClaims
from services.apps.event_runner import EventRunner, place_of, version
from services.apps.host import Host, Part
from services.apps.recorder import Recorder
from swarm import clock
from swarm.app.devices import Devices
from swarm.app.event_app import channels_of
from swarm.app.overlays import Message, Overlays
from swarm.app.run_options import RunOptions
from swarm.bus.throttle import APP_STATE_S, Throttle
from swarm.core.asynchronous import HANG, Asynchronous, Call, Publish
from swarm.core.lockstep_frames import Channel
from swarm.errors import AppError, FrameError, PayloadError, SwarmError
from swarm.messages import AppProgress, AppState, Topology
from swarm.messages.codec import Value, decode, encode
from swarm.messages.keys import key
from swarm.process.service import Service

TICK = 0.1
"""s between two looks of the ticker: state goes out at 10 Hz at most, for people and programs that watch."""
EVERY = 1.0
"""s between two messages of progress and state when nothing changes."""
REMIND = 0.5
"""s between two looks for requests that have no answer yet."""
CLOSE_WITHIN = 2.0
"""s that a running handler has when the process is to end."""


class EventHost:
    """One event-driven or periodic app on one robot, until closed."""

    def __init__(
        self,
        service: Service,
        name: str,
        runner: EventRunner,
        code: tuple[str, bytes],
        run: int,
        links: topology.Links,
        run_options: RunOptions,
        overlays: Overlays,
        devices: Devices,
        recorder: Recorder | None = None,
    ) -> None:
        """`code`: path and digest of the app's source. Raises `LocalError` where another process runs this app."""
        self._service = service
        self._name = name
        self._runner = runner
        self._overlays = overlays
        self._devices = devices
        app = runner.app
        self._claim = Claim(service.runtime, name)
        if not links.kept:
            topology.save(service.runtime, name, run, links)
        channel = Channel(run, 0, self._claim.incarnation, version(app, code[1]))
        self._core = Asynchronous(
            service.robot,
            links.neighbours(service.robot),
            channel,
            runner.schema.size,
            service.config.names,
            period=runner.period,
            barrier=app.barrier and runner.period is not None,
            handled=runner.handled,
            last=run_options.last,
        )
        self._latest = key(service.robot, f"app/{name}", "latest", channel.text)
        self._changed = threading.Condition()  # its lock is the core's
        self._app_lock = threading.Lock()
        self._todo: queue.SimpleQueue[Call | None] = queue.SimpleQueue()
        self._closing = self._hung = False
        self._changed_at = clock.now()
        self._state: AppState | None = None
        self._recorder = recorder
        self._recorded = -1
        self._device_claims = DeviceClaims(devices)
        self._edges = links.config.edges
        record = None if recorder is None else recorder.parameters
        bus, robot, kept = service.bus, service.robot, (service.runtime / f"app.{name}.parameters", run)
        self._changes = Changes(bus, robot, name, app, self._change, self._refuse, kept=kept, record=record)
        runner.change(self._changes.kept())
        app.robot.timers = self._after
        self._views = {name: getattr(app, name) for name in channels_of(type(app))}
        self._channels: Host | None = None
        self._open_channels = partial(self._host_channels, code, run, links, run_options)
        self._subscribe()
        # Daemons: a handler that never returns must not keep the process from ending.
        self._threads = [
            threading.Thread(target=self._guarded, args=(loop,), name=loop.__name__.strip("_"), daemon=True)
            for loop in (self._worker, self._ticker)
        ]
        for thread in self._threads:
            thread.start()
        self._feed(self._core.begin)
        service.ready()

    @property
    def failed(self) -> bool:
        """Whether the app has stopped for a fault."""
        return self._core.failure != "" or self._hung or (self._channels is not None and self._channels.failed)

    def nudge(self) -> None:
        """The bus or a link came up."""
        if self._channels is not None:
            self._channels.nudge()

    def close(self) -> None:
        """End the threads and give back what the app has taken. A handler that runs is waited for, but not for ever."""
        self._closing = True
        self._todo.put(None)
        with self._changed:
            self._changed.notify_all()
        for thread in self._threads:
            thread.join(CLOSE_WITHIN)
            if thread.is_alive():
                self._service.log.warning("the app does not end: %s", self._hanging())
        self._device_claims.close()
        if self._channels is not None:
            self._channels.close()
        self._claim.close()

    def _subscribe(self) -> None:
        bus, robot, name = self._service.bus, self._service.robot, self._name
        # Of whomever the mesh brings: neighbours may change.
        bus.subscribe(key("*", f"app/{name}", "latest", "*"), self._on_latest)
        bus.subscribe(key(robot, "mesh", "topology"), self._on_topology)
        self._throttle = Throttle(bus, key(robot, f"app/{name}", "state"), APP_STATE_S)
        bus.serve(key(robot, f"app/{name}", "state"), self._answer)
        bus.serve(key(robot, f"app/{name}", "progress"), lambda *_: encode(self._progress()))
        if "on_button" in self._runner.handled:
            self._devices.on_button(lambda button: self._happened("on_button", button))
        if "on_message" in self._runner.handled:
            self._overlays.on_flood(lambda sender, data: self._on_message(Message(sender, data, flooded=True)))
            self._overlays.on_message(lambda sender, data: self._on_message(Message(sender, data, flooded=False)))
        if "on_announced" in self._runner.handled:
            self._overlays.on_complete(lambda origin, answer: self._happened("on_announced", origin, answer))
        if "on_answer" in self._runner.handled:
            self._overlays.on_answer(lambda ticket, answer: self._happened("on_answer", ticket, answer))

    # On Zenoh's thread, some on the worker's

    def _feed(self, act: Callable[[float], object]) -> None:
        """Let the core know of something, and carry out what it wants."""
        with self._changed:
            before = self._core.next_deadline() or math.inf
            act(clock.now())
            self._perform()
            if (self._core.next_deadline() or math.inf) < before:
                self._changed.notify_all()  # the ticker has to wake up sooner

    def _happened(self, handler: str, *arguments: object) -> None:
        self._feed(lambda now: self._core.happened(handler, *arguments, now=now))

    def _on_message(self, message: Message) -> None:
        self._happened("on_message", message)

    def _after(self, seconds: float, name: str) -> None:
        self._feed(lambda now: self._core.after(seconds, name, now))

    def _on_latest(self, name: str, payload: bytes) -> None:
        """A neighbour's state: `swarm/<sender>/app/<app>/latest/<channel>`."""
        _, sender, _, _, _, text = name.split("/")
        try:
            channel = Channel.parse(text)
        except FrameError as error:
            self._service.counters["refused_keys"] += 1
            self._service.log.debug("%s: %s", name, error)
            return
        self._feed(lambda now: self._core.receive(sender, channel, payload, now))

    def _on_topology(self, name: str, payload: bytes) -> None:
        try:
            in_force = decode(Topology, payload, name)
        except PayloadError as error:
            self._refuse(error)
            return
        links = topology.of_edges(self._service.config, in_force.edges)
        if links.config.edges != self._edges:
            self._edges = links.config.edges
            self._runner.move(links.config.graph)
            self._feed(partial(self._core.set_neighbours, links.neighbours(self._service.robot)))

    def _change(self, values: Mapping[str, Value]) -> None:
        with self._changed:
            names = self._runner.change(values)
        for name in names:
            self._happened("on_parameter", name)

    def _refuse(self, error: PayloadError) -> None:
        self._service.counters["refused_payloads"] += 1
        self._service.log.debug("%s", error)

    # On the worker's thread

    def _worker(self) -> None:
        while (call := self._todo.get()) is not None and not self._closing:
            with self._changed:
                k, known = self._core.k, self._core.known(clock.now())
            self._take_channels()
            with self._app_lock:
                own = self._runner.call(call, k, known)
                self._changed_at = clock.now()
            if call.handler == "start" and self._views:
                self._open_channels()
            if call.handler in ("start", "on_parameter"):
                self._changes.tell()
            self._feed(partial(self._returned, own))
            self._keep()

    def _host_channels(self, code: tuple[str, bytes], run: int, links: topology.Links, run_options: RunOptions) -> None:
        """Start the app's locksteps, with the first values that its `start` gave them."""
        mine = self._runner.app.robot
        for view in self._views.values():
            robot = view.app.robot
            robot.bus, robot.overlays, robot.devices = mine.bus, mine.overlays, mine.devices
            robot.mesh_clock, robot.ranging, robot.recording = mine.mesh_clock, mine.ranging, mine.recording
        parts = [Part(name, view.app) for name, view in self._views.items()]
        links = links._replace(kept=True)  # saved already
        endless = replace(run_options, last=None, rule=None)
        host = Host(self._service, self._name, parts, code, run, links, endless, self._recorder, self._claim)
        for name, view in self._views.items():
            view.begin(partial(host.change, name, self._changes.tell))
        self._channels = host

    def _take_channels(self) -> None:
        """Let the app see its channels' newest states: the same ones throughout a handler."""
        if self._channels is None:
            return
        for name, view in self._views.items():
            latest = self._channels.latest(name)
            if latest is not None and latest.k != view.k:
                fields = type(view.app).spec.schema.fields
                view.take(latest.k, {field.name: field.check(latest.state[field.name]) for field in fields})

    def _returned(self, own: bytes, now: float) -> None:
        period = self._runner.period
        if period is not None and period != self._core.period:
            self._core.set_period(period, now)
        self._core.returned(own, now, finished=self._runner.finished)

    def _keep(self) -> None:
        """Record a step, or an event where there are no steps."""
        k = self._core.k
        if self._recorder is not None and k != self._recorded:
            self._recorded = k
            self._recorder.state(k, self._changed_at, self._runner.state(), self._runner.result())

    # On the ticker's thread

    def _ticker(self) -> None:
        told: tuple[object, ...] = ()
        told_at = reminded_at = looked_at = 0.0
        while not self._closing:
            with self._changed:
                self._changed.wait(self._pause(looked_at))
                now = clock.now()
                self._core.handle_timer(now)
                self._perform()
                news = self._report(now)
            self._device_claims.look(well=self._core.phase not in ("fault", "done") and not self._core.hangs(now))
            self._look_for_hang(now)
            if now - reminded_at >= REMIND:
                reminded_at = now
                self._overlays.remind()
            if now - looked_at < TICK:
                continue
            looked_at = now
            repeat = now - told_at >= EVERY
            self._show(repeat)
            changed = news != told
            if repeat or changed:
                told, told_at = news, now
                self._count()
                # A handler that does not end is a fault; waiting for others is none.
                if not self._core.hangs(now):
                    self._service.watchdog()
                progress = self._progress()
                if self._recorder is not None and changed:
                    self._recorder.progress(progress)
                self._publish("progress", progress)

    def _look_for_hang(self, now: float) -> None:
        if self._core.hangs(now) == self._hung:
            return
        self._hung = not self._hung
        if self._hung:
            self._service.log.error("%s", self._hanging())
            self._service.degraded(self._hanging())
        elif not self._core.failure:
            self._service.ready()

    def _pause(self, looked_at: float) -> float:
        now = clock.now()
        due = [looked_at + TICK]
        due += [at for at in (self._core.next_deadline(), self._devices.next_deadline()) if at is not None]
        return max(0.0, min(due) - now)

    def _show(self, repeat: bool) -> None:
        """Publish the state where it may be new and no handler is running (else the next look will find it)."""
        state = self._state
        old = state is not None and state.t == self._changed_at
        if self._core.phase in ("starting", "fault") or (old and not repeat):
            return
        if self._app_lock.acquire(blocking=False):
            try:
                runner = self._runner
                state = AppState(self._changed_at, self._core.k, runner.state(), runner.result())
            except AppError as error:
                with self._changed:
                    self._fail(str(error))
                return
            finally:
                self._app_lock.release()
            self._state = state
            self._publish("state", state)
            self._throttle.publish(state, clock.now(), news=repeat)

    def _count(self) -> None:
        for name, count in {**self._core.counters, "unreadable": self._runner.unreadable}.items():
            self._service.counters[f"latest_{name}"] = count

    def _report(self, now: float) -> tuple[str, tuple[str, ...], str]:
        """Phase, robots waited for, reason."""
        core = self._core
        if core.failure:
            return "fault", (), core.failure
        if core.hangs(now):
            return "fault", (), self._hanging()
        reason = ""
        if core.strangers:
            reason = f"{' '.join(core.strangers)} runs another version of this app: its state is not used"
        elif self._channels is not None and self._channels.faults:
            reason = "; ".join(f"channel {name}: {why}" for name, why in self._channels.faults.items())
        elif core.phase == "done":
            reason = self._runner.app.finished or ""
        return core.phase, core.missing, reason

    def _hanging(self) -> str:
        call = self._core.running
        return "" if call is None else self._runner.hangs(place_of(call, self._core.k), self._threads[0].ident, HANG)

    def _progress(self) -> AppProgress:
        now = clock.now()
        with self._changed:
            phase, peers, reason = self._report(now)
            return AppProgress(now, phase, self._core.k, peers, reason)

    def _answer(self, *_: object) -> bytes | None:
        return None if (state := self._state) is None else encode(state)

    # Everywhere, with the core's lock held

    def _perform(self) -> None:
        """Carry out what the core wants, in its order."""
        for action in self._core.actions():
            match action:
                case Publish(data):
                    self._service.bus.publish(self._latest, data, urgent=True)
                case Call():
                    self._todo.put(action)

    def _fail(self, reason: str) -> None:
        """Call the app no more, say why, and stay: the reason can be read."""
        if not self._core.failure:
            self._core.fail(reason)
            self._service.log.error("%s", reason)
            self._service.degraded(reason)

    def _publish(self, topic: str, message: object) -> None:
        self._service.bus.publish(key(self._service.robot, f"app/{self._name}", topic), message)

    def _guarded(self, loop: Callable[[], None]) -> None:
        """Run a thread's loop; what the app's code raises is a fault of the app. Anything else ends the process."""
        try:
            loop()
        except SwarmError as error:
            with self._changed:
                self._fail(str(error))
