"""The balancer service of one robot under virtual time: the keys of `services.balancer`, a body without physics.

What nobody hears is not made. Buttons are pressed, and robots laid down, by the acts of `sim.core.actions`.
"""

import math
import random
from collections.abc import Callable, Mapping
from functools import partial

from services.balancer.bridge.bus_side import BusSide
from services.balancer.bridge.link import TELEMETRY_S, LoopCommand
from services.balancer.bridge.orders import halt, obey
from services.balancer.core.control.estimation.gyro import SETTLE_S, STILL_SAMPLES
from services.balancer.core.devices.buttons import REPEAT_S, ButtonCounter
from services.balancer.core.devices.leds import LedClaim, Shown, shown
from services.balancer.core.faults import FELL, STOPPED, MotorFault
from sim.core.actions import BUTTONS, Knock, Lay, Press, Push, SimulationAction
from sim.core.scene_record import SceneRecord
from sim.virtual.bus import VirtualBus
from sim.virtual.events import Time
from sim.virtual.periodic_publisher import PeriodicPublisher
from sim.virtual.robot.body import BALANCING, VirtualBody
from sim.virtual.runtime import VirtualRuntime
from swarm.bus.throttle import THROTTLED
from swarm.config import Config
from swarm.errors import LocalError
from swarm.messages import (
    BalancerFault,
    BalancerState,
    Battery,
    Display,
    LedChange,
    Leds,
    Notice,
    Odometry,
    SetDisplay,
    Stop,
    Truth,
    TryMotors,
)
from swarm.messages.keys import key
from swarm.messages.sim import THROTTLED_TRUTH_S, TRUTH_PERIOD_S

BATTERY = 7.4
"""Voltage of the battery, V, which never changes."""
TICK = 0.01
"""Seconds of a tick. Within one a real balancer obeys commands and writes LEDs; this one does so at once."""
GYRO_ZERO_S = SETTLE_S + STILL_SAMPLES * TICK
"""Seconds for which a robot that was switched on rests, since its balancer looks for the gyro's zero."""


class VirtualBalancer:
    """One robot's body, and what `services.balancer.bridge.bus_side` needs of its loop."""

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
        """The state of the LEDs."""
        self.powered = True
        """Whether the robot is switched on."""
        self.begins_to_move: Callable[[str], object] = str
        """Function that is called with the robot's name whenever the robot may begin to move."""
        self._time = time
        self.bus = bus
        self._scene_record = scene_record
        self._claim = LedClaim()
        self._counter = ButtonCounter()
        self._held = [0.0] * len(BUTTONS)
        """The time until which each button is held."""
        self._stands_at = math.inf
        """The time at which a robot that was switched on stands up, unless a stop or another mode comes before."""
        self._side = BusSide(VirtualRuntime(robot, time, bus), lambda: time.now, self)
        self._side.listen(self._put)
        truth, self._sim_leds_key = key(robot, "sim", "truth"), key(robot, "sim", "leds")
        phase = numbers.random()
        time.soon(self._show_leds)
        odometry_and_state = self._side.key(Odometry), *self._side.state_keys
        PeriodicPublisher(time, bus, odometry_and_state, TELEMETRY_S, time.now + TELEMETRY_S * phase, self._tell)
        for truth_key, period in ((truth, TRUTH_PERIOD_S), (f"{truth}/{THROTTLED}", THROTTLED_TRUTH_S)):
            tell_truth = partial(self._tell_truth, truth_key)
            PeriodicPublisher(time, bus, (truth_key,), period, time.now + period * phase, tell_truth)
        time.at(time.now + REPEAT_S * phase, self._tell_slowly)
        if scene_record is not None:
            time.soon(self._be_seen, scene_record)

    def look(self) -> VirtualBody:
        """Return the robot's body as it is now."""
        self.body.advance(self._time.now)
        return self.body

    def act(self, act: SimulationAction) -> None:
        """Do a person's action to the robot."""
        now = self._time.now
        match act:
            case Press(button, seconds):
                self._held[BUTTONS.index(button)] = now + seconds
                self._time.at(now + seconds, self._tell_buttons)
                self._tell_buttons()
            case Lay(side):
                self.body.lay(side, now)
                self._show_leds()
            case Push(impulse):
                self.body.push(impulse, now)
                self._changed()
            case Knock(impulse, dx, dy):
                mode = self.body.mode
                self.body.knock(impulse, dx, dy, now)
                if self.body.mode != mode:
                    self._changed()
                return  # whoever looks at contacts knows where it is
            case _:
                raise LocalError("under virtual time a body stands where it has driven to: it cannot be put elsewhere")
        self.begins_to_move(self.robot)

    def switch_off(self, *, falls: bool) -> None:
        """Switch the robot off: it says nothing any more, and its motors are off."""
        if falls:
            self.body.command("rest", self._time.now)
            self._show_leds()
            self.begins_to_move(self.robot)
        self.powered = False
        self._stands_at = math.inf
        self._claim.clear()

    def switch_on(self, *, stands: bool) -> None:
        """Switch the robot on. Where it `stands`, it stands up when it knows its gyro's zero."""
        self.powered = True
        if stands:
            self._stands_at = self._time.now + GYRO_ZERO_S
            self._time.at(self._stands_at, self._stand_up)
        self._changed()

    def _stand_up(self) -> None:
        """Stand up, and leave the LEDs to an app that has taken them since the start."""
        now = self._time.now
        if now >= self._stands_at:
            self._stands_at = math.inf
            self.body.command("stand", now)
            self._changed()
            self.begins_to_move(self.robot)

    # -- the process -------------------------------------------------------------------------------------------

    def _put(self, name: str, payload: bytes) -> None:
        if not self.powered:
            return
        self._side.command(name, payload, self._time.now)

    # -- the loop ----------------------------------------------------------------------------------------------

    def halt(self, stop: Stop) -> None:
        halt(self, stop)

    def take(self, command: LoopCommand, heard: float) -> bool:
        """See `services.balancer.bridge.bus_side.LoopLink`. What only a real device can do is left undone."""
        obey(self, command, heard, VirtualRuntime.log)
        return True

    def show(self, request: SetDisplay) -> None:
        self._side.publish(Display(self._time.now, True, tuple(request.text.split("\n"))))

    # -- the balancer, see `services.balancer.bridge.orders.Obedient` ------------------------------------------------

    def drive(self, speed: float, turn_rate: float, seconds: float, now: float) -> None:
        """Drive for a time."""
        if cut := self.body.drive(speed, turn_rate, seconds, now):
            self.notice("velocity", cut)
        self.begins_to_move(self.robot)

    def command(self, mode: str, now: float) -> None:
        self.body.command(mode, now)
        self._stands_at = math.inf
        self._claim.clear()
        self._changed()
        self.begins_to_move(self.robot)

    def test_motors(self, request: TryMotors, now: float) -> None:
        raise LocalError("motors: under virtual time a body has no motors that could be tested")

    def change(self, parameters: Mapping[str, float]) -> None:
        raise LocalError("parameters: under virtual time a body has no physics that they could change")

    def claim_leds(self, leds: Shown, seconds: float, now: float, at: float | None = None) -> None:
        """Show the LEDs that an app wants."""
        order = self._claim.order(leds, seconds, now, at)
        self._time.at(order.at, self._show_leds)
        self._time.at(order.until, self._show_leds)

    def stop(self, reason: str) -> bool:
        """Switch the motors off."""
        self._stands_at = math.inf
        if self.body.fault:
            return False
        self.body.stop(f"stopped: {reason}", self._time.now)
        self._changed()
        return True

    def notice(self, about: str, text: str) -> None:
        """Tell people something about a command."""
        self._side.publish(Notice(self._time.now, about, text))

    # -- what it tells -----------------------------------------------------------------------------------------------

    def _show_leds(self) -> None:
        now, body = self._time.now, self.body
        body.advance(now)
        leds = shown(body.mode, _name(body.fault), self._claim.leds(now), low_battery=False, now=now)
        if self.shown == leds:
            return
        self.shown = leds
        if self._scene_record is not None:
            self._scene_record.leds(self.robot, self._time.true, yellow=leds[1])
        self._side.publish(Leds(now, *leds))
        self.bus.publish(self._sim_leds_key, LedChange(now, *leds))

    def _changed(self) -> None:
        """Note another mode, which may change by itself once more."""
        self._show_leds()
        self._tell_state()
        if (then := self.body.next_change) < math.inf:
            self._time.at(then, self._changed)
        if self._wanted(BalancerFault):
            reason = self.body.fault
            fault = MotorFault(_name(reason), reason) if reason else None
            told = ("", "", "") if fault is None else (fault.name, fault.reason, fault.recovery)
            self._side.publish(BalancerFault(self._time.now, *told))

    def _tell(self) -> None:
        if not self.powered:
            return
        if self._wanted(Odometry):
            self._side.publish(self.body.odometry(self._time.now))
        self._tell_state()

    def _tell_state(self) -> None:
        if not any(map(self.bus.wanted, self._side.state_keys)):
            return
        self._side.publish(self.state())

    def state(self) -> BalancerState:
        """Return the present state of the body."""
        now, body = self._time.now, self.body
        body.advance(now)
        speed, turn_rate = body.demand
        return BalancerState(
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

    def _tell_truth(self, truth_key: str) -> None:
        now, body = self._time.now, self.body
        body.advance(now)
        self.bus.publish(truth_key, Truth(now, body.x, body.y, body.heading, body.tilt))

    def _be_seen(self, scene_record: SceneRecord) -> None:
        now, body = self._time.now, self.body
        self._time.at(now + TELEMETRY_S, self._be_seen, scene_record)
        body.advance(now)
        scene_record.pose(self.robot, self._time.true, (body.x, body.y), body.tilt)

    def _tell_slowly(self) -> None:
        """Publish what is published once a second."""
        self._time.at(self._time.now + REPEAT_S, self._tell_slowly)
        if not self.powered:
            return
        if self._wanted(Battery):
            self._side.publish(Battery(self._time.now, BATTERY))
        if self._wanted(Leds) and self.shown is not None:
            self._side.publish(Leds(self._time.now, *self.shown))
        self._tell_buttons()

    def _tell_buttons(self) -> None:
        now = self._time.now
        down = sum(1 << bit for bit, until in enumerate(self._held) if now < until)
        if (buttons := self._counter.update(down, now)) is not None:
            self._side.publish(buttons)

    def _wanted(self, kind: type) -> bool:
        return self.bus.wanted(self._side.key(kind))


def _name(fault: str) -> str:
    """Return the name of a fault of the body by its text; a body without physics has two faults."""
    return "" if not fault else FELL if fault == FELL else STOPPED
