"""A swarm of one event-driven or periodic app, all robots in this process: virtual time, no thread, no loss."""

import heapq
import itertools
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from services.apps import loader
from services.apps.event_runner import EventRunner, version
from sim.rehearsal.clock import CommonClock, NoRanges
from sim.rehearsal.messages import RehearsalOverlays
from swarm.app.devices import Devices
from swarm.app.event_app import EventApp
from swarm.app.overlays import Message
from swarm.config import Config
from swarm.core.asynchronous import Asynchronous, HandlerCall, Publish
from swarm.core.lockstep_frames import Channel
from swarm.errors import AppError
from swarm.messages import Buttons
from swarm.messages.codec import Value, encode

LATENCY = 0.03
"""s that a message takes to a neighbour, or with a flood to anybody."""
HANDLER_TIME = 0.001
"""s that a handler takes."""


class FakeBus:
    """Keeps what is published, and hands on what one lets come."""

    connected = True

    def __init__(self, now: Callable[[], float]) -> None:
        """`now`: the time that what is published gets."""
        self._now = now
        self.published: list[tuple[float, str, Any]] = []
        """Time, key and message of all that was published."""
        self._callbacks: dict[str, Callable[[str, bytes], None]] = {}

    def publish(self, key: str, message: object, *, urgent: bool = False) -> None:
        """See `Bus`."""
        self.published.append((self._now(), key, message))

    def subscribe(self, keys: str | Iterable[str], callback: Callable[[str, bytes], None]) -> None:
        """See `Bus`."""
        for key in (keys,) if isinstance(keys, str) else keys:
            self._callbacks[key] = callback

    def come(self, key: str, message: object) -> None:
        """Somebody else has published this."""
        self._callbacks[key](key, encode(message))

    def sent(self, kind: type) -> list[tuple[float, Any]]:
        """Messages of one type with their times."""
        return [(time, message) for time, _, message in self.published if isinstance(message, kind)]


class Unit:
    """One robot."""

    def __init__(
        self, world: "EventRehearsal", app: loader.LoadedApp, config: Config, name: str, last: int | None
    ) -> None:
        """`last`: the step after which the app ends."""
        self.world = world
        self.name = name
        self.bus = FakeBus(lambda: world.now)
        self.messages = RehearsalOverlays(name, config.names, self._send)
        instance = app.make(config, name, seed=1)
        if not isinstance(instance, EventApp):
            raise AppError(f"{app.source}: {type(instance).__name__} is no EventApp or PeriodicApp")
        self.app: Any = instance
        self.runner = EventRunner(instance, app.source)
        self.devices = Devices(self.bus, name, lambda: world.now)  # type: ignore[arg-type]
        robot = instance.robot
        robot.time = lambda: world.now
        robot.bus, robot.devices, robot.overlays = self.bus, self.devices, self.messages  # type: ignore[assignment]
        robot.mesh_clock = CommonClock(config.names[0], lambda: world.now)  # type: ignore[assignment]
        robot.ranging = NoRanges()  # type: ignore[assignment]
        robot.timers = lambda seconds, text: self.core.after(seconds, text, world.now)
        self.fault = ""
        """Why the app ended; empty while it runs."""
        self.core: Asynchronous = Asynchronous(
            name,
            config.neighbours(name),
            Channel(1, 0, 1, version(instance, app.digest)),
            self.runner.schema.size,
            config.names,
            period=self.runner.period,
            barrier=instance.barrier,
            handled=self.runner.handled,
            last=last,
        )
        if "on_button" in self.runner.handled:
            self.devices.on_button(
                lambda button: self.feed(lambda now: self.core.happened("on_button", button, now=now))
            )
        self.bus_presses = [0, 0, 0]

    def _send(self, to: str, message: Message) -> None:
        other = self.world.units[to]
        self.world.at(
            self.world.now + LATENCY,
            lambda: other.feed(lambda now: other.core.happened("on_message", message, now=now)),
        )

    def press(self, button: str) -> None:
        """Somebody presses "a", "b" or "c"."""
        key = f"swarm/{self.name}/balancer/buttons"
        self.bus.come(key, Buttons(self.world.now, False, False, False, *self.bus_presses))
        self.bus_presses["abc".index(button)] += 1
        self.bus.come(key, Buttons(self.world.now, False, False, False, *self.bus_presses))

    def feed(self, act: Callable[[float], object]) -> None:
        """Let something happen, and do what follows from it."""
        act(self.world.now)
        self.carry_out()

    def carry_out(self) -> None:
        """Do what the core wants."""
        world = self.world
        for action in self.core.actions():
            if isinstance(action, Publish):
                for name in self.core.neighbours:
                    world.at(world.now + LATENCY, lambda name=name, data=action.data: self._deliver(name, data))  # type: ignore[misc]
                continue
            try:
                own = world.call(self, action)
            except AppError as error:
                self.fault = str(error)
                self.core.fail(self.fault)
                return
            world.at(world.now + HANDLER_TIME, lambda own=own: self._returned(own))  # type: ignore[misc]
        due = [at for at in (self.core.next_deadline(), self.devices.next_deadline()) if at is not None]
        if due:
            world.at(max(world.now, min(due)), self._tick)

    def call(self, call: HandlerCall) -> bytes:
        """Let the app handle an event; its state, packed."""
        return self.runner.call(call, self.core.k, self.core.known(self.world.now))

    def result(self) -> Mapping[str, Value]:
        """What the robot reports now."""
        return self.runner.result()

    def _deliver(self, name: str, data: bytes) -> None:
        other = self.world.units[name]
        other.feed(lambda now: other.core.receive(self.name, self.core.channel, data, now))

    def _returned(self, own: bytes) -> None:
        if self.runner.period not in (None, self.core.period):
            self.core.set_period(self.runner.period or 0.0, self.world.now)
        self.core.returned(own, self.world.now, finished=self.runner.finished)
        self.carry_out()

    def _tick(self) -> None:
        self.devices.handle_timer()
        due = self.core.next_deadline()
        if due is not None and due <= self.world.now:
            self.core.handle_timer(self.world.now)
            self.carry_out()


class EventRehearsal:
    """Runs an app on all robots of a configuration."""

    def __init__(
        self,
        app: loader.LoadedApp,
        config: Config,
        last: int | None = None,
        call: Callable[[Unit, HandlerCall], bytes] | None = None,
    ) -> None:
        """`last`: the step after which a periodic app ends. `call` takes the place of the plain call of a handler."""
        self.now = 0.0
        """Virtual time, s."""
        self.call = call or Unit.call
        self._queue: list[tuple[float, int, Callable[[], None]]] = []
        self._order = itertools.count()
        self.units = {name: Unit(self, app, config, name, last) for name in config.names}
        for unit in self.units.values():
            unit.feed(unit.core.begin)

    def at(self, time: float, act: Callable[[], None]) -> None:
        """Do something later."""
        heapq.heappush(self._queue, (time, next(self._order), act))

    def run(self, until: float) -> None:
        """Let time pass, s since the start."""
        while self._queue and self._queue[0][0] <= until:
            time, _, act = heapq.heappop(self._queue)
            self.now = max(self.now, time)
            act()
        self.now = until
