"""The host of an event-driven or periodic app under virtual time: what `services.apps.event_host` is in a process.

A handler takes no time here. One that never returns would stop the whole run, as it would a robot's app.
"""

import math
from collections.abc import Mapping

from services.apps.changes import Changes
from services.apps.event_host import REMIND, TICK
from services.apps.event_runner import EventRunner, version
from services.apps.topology import of_edges
from sim.virtual.host import Place, VirtualHost
from sim.virtual.strand import Line, Told
from swarm.app.devices import Devices
from swarm.app.overlays import Message, Overlays
from swarm.config import Config
from swarm.core.asynchronous import Asynchronous, Call, Publish
from swarm.core.lockstep_frames import Channel
from swarm.errors import AppError, FrameError, PayloadError
from swarm.messages import AppProgress, AppState, Topology
from swarm.messages.codec import Value, decode
from swarm.messages.keys import key


class VirtualEventHost:
    """One event-driven or periodic app on one robot."""

    def __init__(
        self,
        name: str,
        runner: EventRunner,
        digest: bytes,
        place: Place,
        config: Config,
        channels: VirtualHost | None,
        told: Told,
    ) -> None:
        """`channels`: the lockstep channels of the app, started after its `start`."""
        self.app = name
        self.part = ""
        self.robot = place.robot
        self.runner = runner
        self.reason = ""
        """Why it has stopped; empty where it has not."""
        self.over = False
        """Whether it is done, or has stopped."""
        self._place = place
        self._time = place.time
        self._told = told
        self.channels = channels
        app, bus = runner.app, place.bus
        overlays, devices = app.robot.overlays, app.robot.devices
        assert overlays is not None
        assert devices is not None
        self._overlays: Overlays = overlays
        self._devices: Devices = devices
        channel = Channel(place.run, 0, place.incarnation, version(app, digest))
        self._core = Asynchronous(
            place.robot,
            place.neighbours,
            channel,
            runner.schema.size,
            config.names,
            period=runner.period,
            barrier=app.barrier and runner.period is not None,
            handled=runner.handled,
            last=place.run_options.last,
        )
        self._latest = key(place.robot, f"app/{name}", "latest", channel.text)
        self._state_key = key(place.robot, f"app/{name}", "state")
        self._progress_key = key(place.robot, f"app/{name}", "progress")
        self._shown: tuple[str, int] | None = None
        self._recorded = -1
        self._timer = self._devices_timer = math.inf
        self._config = config
        self._edges: tuple[tuple[str, ...], ...] = ()
        self._senders: dict[str, tuple[str, Channel] | None] = {}
        self._changes = Changes(bus, place.robot, name, app, self._change, _refuse, lambda: self._time.now)
        app.robot.timers = self._after
        if config.auto:
            bus.subscribe(key("*", f"app/{name}", "latest", "*"), self._on_latest)
            bus.subscribe(key(place.robot, "mesh", "topology"), self._on_topology)
        else:  # the links are those of the start: nobody can set others
            for peer in place.neighbours:
                bus.subscribe(key(peer, f"app/{name}", "latest", "*"), self._on_latest)
        if "on_button" in runner.handled:
            devices.on_button(lambda button: self._happened("on_button", button))
        if "on_message" in runner.handled:
            overlays.on_flood(lambda sender, data: self._happened("on_message", Message(sender, data, flooded=True)))
            overlays.on_message(lambda sender, data: self._happened("on_message", Message(sender, data, flooded=False)))
        if "on_announced" in runner.handled:
            overlays.on_complete(lambda origin, answer: self._happened("on_announced", origin, answer))
        if "on_answer" in runner.handled:
            overlays.on_answer(lambda ticket, answer: self._happened("on_answer", ticket, answer))

    @property
    def k(self) -> int:
        """Steps done, or events where the app has no steps."""
        return self._core.k

    @property
    def waiting(self) -> tuple[str, ...]:
        """Robots that the barrier waits for."""
        return self._core.missing

    @property
    def obstacle(self) -> str:
        """None but those: an asynchronous app has no members to agree on."""
        return ""

    def start(self) -> None:
        """Let the app begin."""
        self._core.begin(self._time.now)
        self._perform()
        self._time.at(self._time.now + TICK, self._show)
        self._time.at(self._time.now + REMIND, self._remind)

    # -- what happens --------------------------------------------------------------------------------------------

    def _happened(self, handler: str, *arguments: object) -> None:
        self._core.happened(handler, *arguments, now=self._time.now)
        self._perform()

    def _after(self, seconds: float, name: str) -> None:
        self._core.after(seconds, name, self._time.now)
        self._wind()

    def _on_latest(self, name: str, payload: bytes) -> None:
        """A neighbour's state: `swarm/<sender>/app/<app>/latest/<channel>`."""
        if name not in self._senders:
            self._senders[name] = _parsed(name)
        known = self._senders[name]
        if known is not None:
            self._core.receive(*known, payload, self._time.now)
            self._perform()

    def _on_topology(self, name: str, payload: bytes) -> None:
        in_force = decode(Topology, payload, name)
        if in_force.edges != self._edges:
            self._edges = in_force.edges
            graph = of_edges(self._config, in_force.edges).config.graph
            self.runner.move(graph)
            self._core.set_neighbours(graph.neighbours(self.robot), self._time.now)
            self._perform()

    def _change(self, values: Mapping[str, Value]) -> None:
        for name in self.runner.change(values):
            self._happened("on_parameter", name)

    def _tick(self, planned: float) -> None:
        if planned != self._timer:
            return  # an earlier one came before
        self._timer = math.inf
        self._core.handle_timer(self._time.now)
        self._perform()

    def _hold_devices(self, planned: float) -> None:
        if planned != self._devices_timer:
            return
        self._devices_timer = math.inf
        if not self.over:
            self._devices.handle_timer()
            self._wind()

    # -- what is done ---------------------------------------------------------------------------------------------

    def _perform(self) -> None:
        """Carry out what the core wants, in its order."""
        for action in self._core.actions():
            if type(action) is Publish:
                self._place.bus.publish(self._latest, action.data, urgent=True)
            elif type(action) is Call:
                # Not from within a handler: what it does may lead to the next call.
                self._time.soon(self._call, action)
        self._wind()

    def _call(self, call: Call) -> None:
        if self._core.failure:
            return
        now, core, runner = self._time.now, self._core, self.runner
        try:
            own = runner.call(call, core.k, core.known(now))
        except AppError as error:
            self._fail(str(error))
            return
        if call.handler in ("start", "on_parameter"):
            self._changes.tell()
        if call.handler == "start" and self.channels is not None:
            for part, strand in self.channels.strands.items():
                strand.runner.changed = self._changes.tell
                getattr(runner.app, part).begin(strand.runner.change)
            self.channels.start()
        if runner.period is not None and runner.period != core.period:
            core.set_period(runner.period, now)
        core.returned(own, now, finished=runner.finished)
        self._keep()
        self._perform()
        if core.phase == "done" and not self.over:
            self._end()

    def _keep(self) -> None:
        """A step, or an event where there are no steps."""
        if self._core.k == self._recorded:
            return
        self._recorded = self._core.k
        try:
            line = Line(self._core.k, self._time.now, self.runner.state(), self.runner.result())
        except AppError as error:
            self._fail(str(error))
            return
        self._told.advanced(self, line)

    def _wind(self) -> None:
        deadline = self._core.next_deadline()
        if deadline is not None and deadline < self._timer:
            self._timer = deadline
            self._time.at(deadline, self._tick, deadline)
        claim = self._devices.next_deadline()
        if claim is not None and claim < self._devices_timer:
            self._devices_timer = claim
            self._time.at(claim, self._hold_devices, claim)

    def _fail(self, reason: str) -> None:
        if not self.over:
            self._core.fail(reason)
            self.reason = reason
            self._end()

    def _end(self) -> None:
        self.over = True
        self._devices.release()
        self._told.ended(self)

    # -- what is told ---------------------------------------------------------------------------------------------

    def _remind(self) -> None:
        self._time.at(self._time.now + REMIND, self._remind)
        self._overlays.remind()

    def _show(self) -> None:
        """State and progress where they are new and somebody hears them."""
        self._time.at(self._time.now + TICK, self._show)
        core, runner, bus = self._core, self.runner, self._place.bus
        if self._shown == (core.phase, core.k):
            return
        self._shown = core.phase, core.k
        if bus.wanted(self._progress_key):
            bus.publish(self._progress_key, AppProgress(self._time.now, core.phase, core.k, core.missing, self.reason))
        if core.phase not in ("starting", "fault") and bus.wanted(self._state_key):
            bus.publish(self._state_key, AppState(self._time.now, core.k, runner.state(), runner.result()))


def _parsed(name: str) -> tuple[str, Channel] | None:
    _, sender, _, _, _, text = name.split("/")
    try:
        return sender, Channel.parse(text)
    except FrameError:
        return None


def _refuse(error: PayloadError) -> None:
    """A request that is none: the bus has no other senders here than our own."""
