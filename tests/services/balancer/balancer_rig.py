"""A robot under virtual time: the balancer's own code against the simulated devices, without threads or waiting."""

import random
from collections.abc import Callable
from dataclasses import replace

from services.balancer.balancer import Balancer
from services.balancer.core.control.body import BodyModel, body_model
from services.balancer.core.control.estimation.gyro import Zero
from services.balancer.core.control.lqr import PERIOD_S
from services.balancer.core.devices import imu
from sim.core.balboa import BalboaBody
from sim.core.devices import NO_ERRORS, ImuErrors, SimulatedRobot, draw_errors
from sim.devices.i2c import SimulatedBus
from swarm.config.types import Balancing, Body

CONFIGURED = body_model("zero2w", Body())
"""The body the balancer believes in."""

OTHER = BodyModel(
    mass=0.43,
    wheel_mass=0.04,
    lever=0.030,
    inertia=1.3e-3,
    wheel_inertia=3.2e-5,
    rotor_inertia=111**2 * 1.2e-8,
    wheel_radius=0.040,
    counts_per_turn=12 * 110.25,
    stall_torque=0.36,
    free_speed=31.0,
    friction=0.008,
)
"""A second estimate of the same robot: heavier, with the rotors' inertia on its own."""


def scaled(model: BodyModel, name: str, factor: float) -> BodyModel:
    return replace(model, **{name: getattr(model, name) * factor})


PLANTS = {"configured": CONFIGURED, "other": OTHER} | {
    f"{set_name} {name} {factor:+.0%}": scaled(model, name, 1 + factor)
    for set_name, model in (("configured", CONFIGURED), ("other", OTHER))
    for name in ("mass", "lever", "inertia", "stall_torque", "free_speed")
    for factor in (-0.2, 0.2)
}
"""Both estimates, and each with one parameter a fifth off."""


NO_OFFSETS = NO_ERRORS._replace(gyro_noise=imu.GYRO_SCALE, acceleration_noise=imu.ACCELERATION_SCALE)
"""A sensor without offsets, and with noise of a count: one without any is taken for frozen."""


class Rig:
    """One robot. `lateness(tick)` delays the start of a tick; `transfer_s` is the time a tick spends on the bus."""

    def __init__(
        self,
        plant: BodyModel = CONFIGURED,
        *,
        believed: BodyModel = CONFIGURED,
        seed: int = 1,
        tilt: float = 0.0,
        held: bool = True,
        start_mode: str = "stand",
        trim: float = 0.0,
        lateness: Callable[[int], float] = lambda _tick: 0.0,
        errors: ImuErrors | None = None,
        place: tuple[float, float, float] = (0.0, 0.0, 0.0),
        kept_zero: Zero | None = None,
        **settings: object,
    ) -> None:
        noise = random.Random(seed)
        self.now = self.deadline = 100.0
        self.body = BalboaBody(plant, self.now, place=place, tilt=tilt, held=held)
        drawn = draw_errors(noise) if errors is None else errors
        self.robot = SimulatedRobot(self.body, noise, errors=drawn, trim=trim)
        self.bus = SimulatedBus(self.robot, self.clock)
        self.balancer = Balancer(
            self.bus,
            believed,
            trim,
            self.clock,
            self._sleep,
            start_mode=start_mode,
            settings=Balancing(**settings),
            kept_zero=kept_zero,
        )
        self.lateness = lateness
        self.tick = 0
        self.worst_tilt = 0.0

    def clock(self) -> float:
        self.now += 50e-6  # a transfer takes a moment
        return self.now

    def _sleep(self, seconds: float) -> None:
        self.now += seconds

    def run(self, seconds: float, *, until: Callable[["Rig"], bool] | None = None) -> "Rig":
        """Tick until `seconds` of virtual time are over or `until` holds; missed ticks are left out, as in the loop."""
        end = self.deadline + seconds
        while self.deadline < end - PERIOD_S / 2:
            self.now = max(self.now, self.deadline + self.lateness(self.tick))
            self.balancer.step(self.now)
            self.balancer.show_leds(self.now)
            self.tick += 1
            self.worst_tilt = max(self.worst_tilt, abs(self.body.tilt))
            self.deadline += PERIOD_S
            if self.now > self.deadline:
                self.deadline += ((self.now - self.deadline) // PERIOD_S + 1) * PERIOD_S
            if until is not None and until(self):
                break
        return self


def upright(**arguments: object) -> Rig:
    """A rig that has just begun to balance from a standing start."""
    rig = Rig(**arguments).run(5.0, until=lambda rig: rig.balancer.mode == "balancing")
    assert rig.balancer.mode == "balancing"
    return rig


__all__ = ["CONFIGURED", "NO_ERRORS", "NO_OFFSETS", "OTHER", "PLANTS", "Rig", "scaled", "upright"]
