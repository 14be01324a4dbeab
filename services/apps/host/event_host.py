"""The shell around one event-driven or periodic app: its neighbours' states on the bus, its handlers, state and
progress.

Handlers run one at a time, on a worker: an author's code may take its time, or never return. So the author's result is
computed there, too, after a handler or between two of them.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import lru_cache, partial

from services.apps.core.terms import Told
from services.apps.equipment.device_claims import DeviceClaims
from services.apps.event_runner import EventRunner, version
from services.apps.faults import bounded
from services.apps.host.app_status import LOOK_EVERY, AppStatus
from services.apps.host.changes import Changes
from services.apps.host.host import MOST_KEYS, LockstepHost, Part
from services.apps.host.lockstep_driver import CLOSE_WITHIN
from services.apps.host.observer import Observer, StepRecord
from services.apps.host.topology import RunPlace, of_edges
from services.apps.persistence.storage import Storage
from services.apps.runner import Runner
from swarm.app.devices import Devices
from swarm.app.event_app import ChannelView, channels_of
from swarm.app.overlays import Message, Overlays
from swarm.app.robot import Robot
from swarm.config import Config
from swarm.core.asynchronous import HANG, Asynchronous, HandlerCall, NeighbourState, Publish
from swarm.core.lockstep.frames import Channel
from swarm.errors import FrameError, SwarmError
from swarm.messages import AppProgress, AppState, Topology
from swarm.messages.codec import Value
from swarm.messages.keys import key
from swarm.process.runtime import Runtime, Timer, listen, refuse

REMIND = 0.5
"""Seconds between two looks for requests that have no answer yet."""


class EventHost:
    """One event-driven or periodic app on one robot, until closed."""

    part = ""

    def __init__(
        self,
        runtime: Runtime,
        name: str,
        runner: EventRunner,
        place: RunPlace,
        config: Config,
        storage: Storage,
        observer: Observer | None,
        *,
        links_change: bool = True,
    ) -> None:
        """`links_change`: whether the mesh may put other links in force meanwhile."""
        app = runner.app
        overlays, devices = app.robot.overlays, app.robot.devices
        assert overlays is not None
        assert devices is not None
        self.app = name
        self.robot = runtime.robot
        self.runner = runner
        self.channels: LockstepHost | None = None
        """The app's locksteps, once its `start` has returned."""
        self._runtime = runtime
        self._bus = runtime.bus
        self._overlays: Overlays = overlays
        self._place = place
        self._config = config
        self._storage = storage
        self._observer = observer
        self._links_change = links_change
        neighbours = place.graph.neighbours(self.robot)
        channel = Channel(place.run, 0, place.incarnation, version(app, place.digest))
        self._core = Asynchronous(
            self.robot,
            neighbours,
            channel,
            runner.schema.size,
            config.names,
            period=runner.period,
            barrier=app.barrier and runner.period is not None,
            handled=runner.handled,
            last=place.options.last,
        )
        self._views: dict[str, ChannelView] = {each: getattr(app, each) for each in channels_of(type(app))}
        self._worker = runtime.worker("handlers")
        self._latest = key(self.robot, f"app/{name}", "latest", channel.text)
        self._status = AppStatus(runtime, f"app/{name}", lambda: self.progress, self._look_at_state)
        self._changed_at = runtime.now
        """The time at which the last handler returned, s."""
        self._tells: Told | None = None
        """What the app tells of the state that it left; None where that is not computed yet."""
        self._recorded = -1
        self._told: tuple[object, ...] = ()
        """Phase, robots waited for and reason that the observer was told last."""
        self._timer = Timer(runtime.at, self._handle_timer)
        self._closed = self._over = self._hung = False
        self._edges: tuple[tuple[str, str], ...] = ()
        self._sender = lru_cache(MOST_KEYS)(self._parse_key)
        record = None if observer is None else partial(observer.parameters, self.robot)
        self._changes = Changes(runtime, name, app, self._change, storage.parameters(name), place.run, record)
        runner.change(self._changes.kept())
        app.robot.timers = runtime.entry(self._after)
        self._claims = DeviceClaims(
            runtime, devices, lambda: self._core.phase not in ("fault", "done") and not self._hung
        )
        for peer in ("*",) if links_change else neighbours:  # the mesh may bring any robot
            self._bus.subscribe(key(peer, f"app/{name}", "latest", "*"), self._on_latest)
        if links_change:
            listen(runtime, key(self.robot, "mesh", "topology"), Topology, self._on_topology)
        self._hear_events(overlays, devices)

    @property
    def failed(self) -> bool:
        """Whether the app has stopped for a fault."""
        return self._core.failure != "" or self._hung or (self.channels is not None and self.channels.failed)

    @property
    def progress(self) -> AppProgress:
        """Return the app's progress, and what holds it up."""
        phase, peers, reason = self._report()
        return AppProgress(self._runtime.now, phase, self._core.k, peers, reason)

    def start(self) -> None:
        """Let the app begin."""
        self._tell_observer()  # who reads a recording knows by it that the app begins anew, with k = 0
        self._core.begin(self._runtime.now)
        self._perform()
        self._runtime.every(LOOK_EVERY, self.look, self._status.keys)
        self._runtime.at(self._runtime.now + REMIND, self._remind)
        self._runtime.ready()

    def nudge(self) -> None:
        """The bus or a link came up."""
        if self.channels is not None:
            self.channels.nudge()

    def close(self) -> None:
        """Give back what the app has taken. A handler that runs is waited for, but not for ever."""
        self._claims.close()
        self._runtime.entry(self._stop)()
        until = self._runtime.now + CLOSE_WITHIN
        if not self._worker.close(CLOSE_WITHIN):
            self._runtime.log.warning("the app does not end: %s", self.runner.hangs(self._worker.thread, CLOSE_WITHIN))
        if self.channels is not None:
            self.channels.close(until - self._runtime.now)

    def _stop(self) -> None:
        self._closed = True

    def look(self) -> None:
        """Publish state and progress where they are new, or were told a while ago."""
        self._look_for_hang()
        repeated, new = self._status.look()
        if repeated:
            for name, count in {**self._core.counters, "unreadable": self.runner.unreadable}.items():
                self._runtime.counters[f"latest_{name}"] = count
        if new and self._report() != self._told:
            self._tell_observer()

    # What happens

    def _hear_events(self, overlays: Overlays, devices: Devices) -> None:
        """Let the app's handlers be called for what happens, as far as it has them."""
        handled = self.runner.handled
        happened, message = self._runtime.entry(self._happened), self._runtime.entry(self._on_message)
        if "on_button" in handled:
            devices.on_button(lambda button: happened("on_button", button))
        if "on_message" in handled:
            overlays.on_flood(lambda sender, data: message(Message(sender, data, flooded=True)))
            overlays.on_message(lambda sender, data: message(Message(sender, data, flooded=False)))
        if "on_announced" in handled:
            overlays.on_complete(lambda origin, answer: happened("on_announced", origin, answer))
        if "on_answer" in handled:
            overlays.on_answer(lambda ticket, answer: happened("on_answer", ticket, answer))

    def _happened(self, handler: str, *arguments: object) -> None:
        self._core.happened(handler, *arguments, now=self._runtime.now)
        self._perform()

    def _on_message(self, message: Message) -> None:
        self._core.happened("on_message", message, now=self._runtime.now, size=len(message.payload))
        self._perform()

    def _after(self, seconds: float, name: str) -> None:
        self._core.after(seconds, name, self._runtime.now)
        self._timer.plan(self._core.next_deadline())

    def _on_latest(self, name: str, payload: bytes) -> None:
        """Take a neighbour's state: `swarm/<sender>/app/<app>/latest/<channel>`."""
        sender = self._sender(name)
        if sender is not None:
            self._core.receive(*sender, payload, self._runtime.now)
            self._perform()

    def _parse_key(self, name: str) -> tuple[str, Channel] | None:
        _, sender, _, _, _, text = name.split("/")
        try:
            return sender, Channel.parse(text)
        except FrameError as error:
            refuse(self._runtime, f"{name}: {error}", "refused_keys")
            return None

    def _on_topology(self, in_force: Topology) -> None:
        if in_force.edges != self._edges:
            self._edges = in_force.edges
            graph = of_edges(self._config, in_force.edges).config.graph
            self.runner.move(graph)
            self._core.set_neighbours(graph.neighbours(self.robot), self._runtime.now)
            self._perform()

    def _change(self, values: Mapping[str, Value]) -> None:
        for name in self.runner.change(values):
            self._happened("on_parameter", name)

    def _remind(self) -> None:
        if not self._closed:
            self._runtime.at(self._runtime.now + REMIND, self._remind)
            self._overlays.remind()

    def _handle_timer(self) -> None:
        if not self._closed:
            self._core.handle_timer(self._runtime.now)
            self._perform()

    # What the core wants

    def _perform(self) -> None:
        """Carry out what the core wants, in its order."""
        if self._closed:
            return
        for action in self._core.actions():
            if type(action) is Publish:
                self._bus.publish(self._latest, action.data, urgent=True)
            elif type(action) is HandlerCall:
                # Not from within a handler: what it does may lead to the next call.
                self._runtime.soon(self._call, action)
        # Not only at the next look, which nobody may want: the barrier falls with a neighbour's word.
        core = self._core
        if self._recorded >= 0 and core.phase not in ("done", "fault") and (core.phase, core.missing) != self._told[:2]:
            self._tell_observer()
        self._timer.plan(core.next_deadline())

    def _call(self, call: HandlerCall) -> None:
        if not self._core.failure and not self._closed:
            self._take_channels()
            known = self._core.known(self._runtime.now)
            job = partial(self._handle, call, self._core.k, known)
            self._worker.run(job, partial(self._returned, call), self._app_failed)

    def _handle(self, call: HandlerCall, k: int, known: Sequence[NeighbourState]) -> tuple[bytes, Told | None]:
        """Let the app handle an event, and tell of each step, or of each event where there are no steps."""
        own = self.runner.call(call, k, known)
        tells = self.runner.period is None or call.handler in ("start", "step") or self.runner.finished
        return own, self.runner.told() if tells else None

    def _returned(self, call: HandlerCall, answer: tuple[bytes, Told | None]) -> None:
        core, runner, now = self._core, self.runner, self._runtime.now
        own, self._tells = answer
        self._changed_at = now
        if call.handler in ("start", "on_parameter"):
            self._changes.tell()
        if call.handler == "start" and self._views:
            self._start_channels()
        if runner.period is not None and runner.period != core.period:
            core.set_period(runner.period, now)
        core.returned(own, now, finished=runner.finished)
        if self._status.late:
            self._status.publish_state()
        self._observe()
        self._perform()
        if core.phase == "done":
            self._end()

    def _observe(self) -> None:
        """Tell of a step, or of an event where there are no steps."""
        k = self._core.k
        if self._observer is None or self._tells is None or k == self._recorded:
            return
        if self._recorded < 0:
            self._tell_observer()
        self._recorded = k
        self._observer.advanced(self, StepRecord(k, self._changed_at, *self._tells))

    def _tell_observer(self) -> None:
        """Tell what the app does now, and whom it waits for."""
        self._told = self._report()
        if self._observer is not None:
            self._observer.progressed(self)

    def _app_failed(self, error: SwarmError) -> None:
        """Call the app no more, say why, and stay: the reason can be read."""
        if not self._core.failure:
            reason = bounded(error)
            self._core.fail(reason)
            self._runtime.log.error("%s", reason)
            self._runtime.degraded(reason)
            self._end()

    def _end(self) -> None:
        if not self._over:
            self._over = True
            self._told = self._report()
            self._claims.look()
            if self._observer is not None:
                self._observer.ended(self)

    # The app's locksteps

    def _start_channels(self) -> None:
        """Start them with the first values that the app's `start` gave them."""
        endless = self._place._replace(options=replace(self._place.options, last=None, rule=None))
        parts = []
        for name, view in self._views.items():
            _equip(view.app.robot, self.runner.app.robot)
            parts.append(Part(name, Runner(view.app, self.runner.source, endless.options.tolerance, view.inputs)))
        self.channels = LockstepHost(
            *(self._runtime, self.app, parts, endless, self._storage, self._observer),
            links_change=self._links_change or endless.options.drop,  # who drops robots asks which links are in force
            whole=False,
        )
        for name, view in self._views.items():
            view.begin(self._runtime.entry(partial(self.channels.change, name, self._changes.tell)))
        self.channels.start()

    def _take_channels(self) -> None:
        """Let the app see the newest states of its locksteps: the same ones throughout a handler."""
        if self.channels is None:
            return
        for name, view in self._views.items():
            latest = self.channels.drivers[name].latest
            if latest is not None and latest.k != view.k:
                schema = type(view.app).spec.schema
                view.take(latest.k, dict(zip(schema.names, schema.unpack(latest.value), strict=True)))

    # What is told

    @property
    def _hangs(self) -> bool:
        since = self._worker.running_since
        return since is not None and self._runtime.now - since >= HANG and not self._core.failure

    def _look_for_hang(self) -> None:
        if self._hangs == self._hung:
            return
        self._hung = not self._hung
        self._claims.look()
        if self._hung:
            self._runtime.log.error("%s", self._hanging())
            self._runtime.degraded(self._hanging())
        elif not self.failed:
            self._runtime.ready()

    def _hanging(self) -> str:
        return self.runner.hangs(self._worker.thread, HANG)

    def _look_at_state(self) -> AppState | None:
        if self._core.phase in ("starting", "fault"):
            return None
        if self._tells is None and not self._worker.busy:
            self._worker.run(self.runner.told, self._take_told, self._app_failed)
        if self._tells is None:
            return None
        return AppState(self._changed_at, self._core.k, self._tells.state, self.runner.known(self._tells.result))

    def _take_told(self, tells: Told) -> None:
        self._tells = tells
        if self._status.late:
            self._status.publish_state()

    def _report(self) -> tuple[str, tuple[str, ...], str]:
        """Phase, robots waited for, reason."""
        core = self._core
        if core.failure:
            return "fault", (), core.failure
        if self._hangs:
            return "fault", (), self._hanging()
        reason = ""
        if core.strangers:
            reason = f"{' '.join(core.strangers)} runs another version of this app: its state is not used"
        elif self.channels is not None and (hindered := self.channels.faults or self.channels.obstacles):
            reason = "; ".join(f"channel {name}: {why}" for name, why in hindered.items())
        elif core.phase == "done":
            reason = self.runner.app.finished or ""
        return core.phase, core.missing, reason


def _equip(inner: Robot, outer: Robot) -> None:
    """Give the robot of a channel's app what the app's own robot has."""
    inner.bus, inner.overlays, inner.devices = outer.bus, outer.overlays, outer.devices
    inner.mesh_clock, inner.ranging, inner.recording = outer.mesh_clock, outer.ranging, outer.recording
    inner.log, inner.said, inner.time, inner.truth = outer.log, outer.said, outer.time, outer.truth
