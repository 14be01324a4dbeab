"""The balancer service of one robot under virtual time: the keys of `services.balancer`, a body without physics.

What nobody hears is not made. Buttons are pressed, and robots laid down, by the acts of `sim.core.actions`.
"""

import math
import random

from services.balancer.core.buttons import REPEAT_S, ButtonCounter
from services.balancer.core.faults import STOPPED
from services.balancer.core.leds import LONGEST_AHEAD_S, LONGEST_CLAIM_S, LedClaim, LedOrder, Shown, shown
from sim.core.actions import BUTTONS, BodyPlace, Lay, Press, Push, SimulationAction
from sim.core.scene_record import SceneRecord
from sim.virtual.body import BALANCING, VirtualBody
from sim.virtual.bus import VirtualBus
from sim.virtual.events import Time
from sim.virtual.periodic_publisher import PeriodicPublisher
from swarm.config import Config
from swarm.errors import LocalError, PayloadError
from swarm.messages import (
    BalancerFault,
    BalancerState,
    Battery,
    Display,
    LedChange,
    Leds,
    Notice,
    SetDisplay,
    SetLeds,
    SetMode,
    SetVelocity,
    Stop,
    Truth,
    read,
)
from swarm.messages.keys import STOP, key

TELEMETRY = 0.04
"""s between two messages of state and odometry, as the service has it."""
TRUTH = 0.1
BATTERY = 7.4
"""V, for ever."""
TICK = 0.01
"""s: commands act, and LEDs are written, within one; here at once."""


class VirtualBalancer:
    """One robot's body and what speaks for it."""

    def __init__(
        self,
        config: Config,
        robot: str,
        model: str,
        time: Time,
        bus: VirtualBus,
        seed: object,
        scene_record: SceneRecord | None = None,
    ) -> None:
        numbers = random.Random(f"{seed} {robot} body")
        place = config.simulation.places.get(robot, (0.0, 0.0, 0.0))
        self.robot = robot
        self.body = VirtualBody(model, config.body_of(robot), config.balancing_of(robot), place, numbers.gauss)
        self.shown: Shown | None = None
        """What the LEDs show."""
        self._time = time
        self._bus = bus
        self._scene_record = scene_record
        self._claim = LedClaim()
        self._counter = ButtonCounter()
        self._held = [0.0] * len(BUTTONS)
        """Until when somebody holds each button."""
        self._keys = {
            topic: key(robot, "balancer", topic)
            for topic in ("state", "odometry", "leds", "buttons", "battery", "display", "fault", "notice")
        }
        self._truth_key, self._sim_leds_key = key(robot, "sim", "truth"), key(robot, "sim", "leds")
        bus.subscribe(key(robot, "balancer", "set", "*"), self._obey)
        bus.subscribe(STOP, self._obey)
        phase = numbers.random()
        time.soon(self._show_leds)
        odometry_and_state = self._keys["odometry"], self._keys["state"]
        PeriodicPublisher(time, bus, odometry_and_state, TELEMETRY, time.now + TELEMETRY * phase, self._tell)
        PeriodicPublisher(time, bus, (self._truth_key,), TRUTH, time.now + TRUTH * phase, self._tell_truth)
        time.at(time.now + REPEAT_S * phase, self._tell_slowly)
        if scene_record is not None:
            time.soon(self._be_seen, scene_record)

    def look(self) -> VirtualBody:
        """Its body, as it is now."""
        self.body.advance(self._time.now)
        return self.body

    def act(self, act: SimulationAction) -> None:
        """What a person does to it."""
        now = self._time.now
        match act:
            case Press(button, seconds):
                self._held[BUTTONS.index(button)] = now + seconds
                self._time.at(now + seconds, self._tell_buttons)
                self._tell_buttons()
            case Lay(side):
                self.body.lay(side, now)
                self._show_leds()
            case Push() | BodyPlace():
                raise LocalError("under virtual time a body has no physics: it can be laid down, not pushed")

    def _obey(self, name: str, payload: bytes) -> None:
        try:
            message = read(name, payload)
        except PayloadError as error:
            self._notice("payload", str(error))
            return
        now, body = self._time.now, self.body
        try:
            match message:
                case SetVelocity(speed, turn_rate, seconds):
                    if cut := body.drive(speed, turn_rate, seconds, now):
                        self._notice("velocity", cut)
                case SetMode(mode):
                    body.command(mode, now)
                    self._claim.clear()
                    self._changed()
                case SetLeds(red, yellow, green, seconds, at):
                    self._order((red, yellow, green), seconds, at)
                case SetDisplay(text):
                    self._bus.publish(self._keys["display"], Display(now, True, tuple(text.split("\n"))))
                case Stop(_, origin, reason) if body.fault == "":
                    body.stop(f"stopped: {reason or 'no reason given'} (by {origin})", now)
                    self._changed()
        except LocalError as error:
            self._notice(name.rpartition("/")[2], f"refused: {error}")

    def _order(self, leds: Shown, seconds: float, at: float | None) -> None:
        now = self._time.now
        if not 0.0 < seconds <= LONGEST_CLAIM_S:
            raise LocalError(f"leds: seconds: expected a time above 0 up to {LONGEST_CLAIM_S:g} s, got {seconds:.6g}")
        if at is not None and not at <= now + LONGEST_AHEAD_S:
            raise LocalError(f"leds: at: expected at most {LONGEST_AHEAD_S:g} s from now on, got {at - now:.6g}")
        begin = now if at is None else max(at, now)
        if not self._claim.take(LedOrder(leds, begin, begin + seconds), now):
            raise LocalError("leds: too many orders wait for their time already")
        self._time.at(begin, self._show_leds)
        self._time.at(begin + seconds, self._show_leds)

    def _show_leds(self) -> None:
        now, body = self._time.now, self.body
        body.advance(now)
        lamps = shown(body.mode, STOPPED if body.fault else "", self._claim.leds(now), low_battery=False, now=now)
        if self.shown == lamps:
            return
        self.shown = lamps
        if self._scene_record is not None:
            self._scene_record.leds(self.robot, self._time.true, yellow=lamps[1])
        self._bus.publish(self._keys["leds"], Leds(now, *lamps))
        self._bus.publish(self._sim_leds_key, LedChange(now, *lamps))

    def _changed(self) -> None:
        """The mode is another one, and may change by itself once more."""
        self._show_leds()
        self._tell_state()
        if (then := self.body.next_change) < math.inf:
            self._time.at(then, self._changed)
        if self._bus.wanted(self._keys["fault"]):
            name = STOPPED if self.body.fault else ""
            self._bus.publish(self._keys["fault"], BalancerFault(self._time.now, name, self.body.fault, ""))

    def _tell(self) -> None:
        if self._bus.wanted(self._keys["odometry"]):
            self._bus.publish(self._keys["odometry"], self.body.odometry(self._time.now))
        self._tell_state()

    def _tell_state(self) -> None:
        if not self._bus.wanted(self._keys["state"]):
            return
        now, body = self._time.now, self.body
        body.advance(now)
        speed, turn_rate = body.demand
        state = BalancerState(
            t=now,
            mode=body.mode,
            tilt=body.tilt,
            tilt_rate=0.0,
            speed=speed,
            duty_left=0.0,
            duty_right=0.0,
            battery=BATTERY,
            ticks=int(now / TICK),
            late_p99=0.0,
            late_max=0.0,
            fault=body.fault,
            posture=body.posture,
            demanded_speed=speed if body.mode == BALANCING else 0.0,
            demanded_turn_rate=turn_rate,
        )
        self._bus.publish(self._keys["state"], state)

    def _tell_truth(self) -> None:
        now, body = self._time.now, self.body
        body.advance(now)
        self._bus.publish(self._truth_key, Truth(now, body.x, body.y, body.heading, body.tilt))

    def _be_seen(self, scene_record: SceneRecord) -> None:
        now, body = self._time.now, self.body
        self._time.at(now + TELEMETRY, self._be_seen, scene_record)
        body.advance(now)
        scene_record.pose(self.robot, self._time.true, (body.x, body.y), body.tilt)

    def _tell_slowly(self) -> None:
        """What is told once a second."""
        self._time.at(self._time.now + REPEAT_S, self._tell_slowly)
        if self._bus.wanted(self._keys["battery"]):
            self._bus.publish(self._keys["battery"], Battery(self._time.now, BATTERY))
        if self._bus.wanted(self._keys["leds"]) and self.shown is not None:
            self._bus.publish(self._keys["leds"], Leds(self._time.now, *self.shown))
        self._tell_buttons()

    def _tell_buttons(self) -> None:
        now = self._time.now
        down = sum(1 << bit for bit, until in enumerate(self._held) if now < until)
        if (buttons := self._counter.update(down, now)) is not None:
            self._bus.publish(self._keys["buttons"], buttons)

    def _notice(self, about: str, text: str) -> None:
        self._bus.publish(self._keys["notice"], Notice(self._time.now, about, text))
