"""Power of a robot by state and its autonomy, from data sheets and the simulated body, beside table 2.5 of the thesis.

The model takes nothing from the measurements of the thesis. The motors' part is computed from the duty and the speed of
each wheel of a simulated robot that its balancer balances and drives under virtual time:

    current of a motor = stall current x (duty - speed / free speed),   its share of the battery's current = duty x that

The simulated wheels turn almost without friction. A real motor takes its no-load current to turn at all, so a wheel
that turns adds what is missing of that current, and the duty that drives it. A motor that brakes gives nothing back.
What is left out: load on the Pi's cores beyond idling, the hardware's backlash and noise, the driver's own losses.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from statistics import fmean

from bench.rigs.timed_robot import TimedRobot
from bench.rows import Row
from services.balancer.core.control.lqr import PERIOD_S
from services.balancer.core.devices.battery import CAPACITY_WH, USABLE, BatteryGuard
from services.balancer.core.devices.battery import FULL as FULL_V

BATTERY_V = 7.54
"""At which the thesis measured (section 2.4)."""
LOGIC_V = 5.0
BOARD_A = 0.035
"""Microcontroller and LEDs of a 32U4 board, 30 to 40 mA typically (Pololu's A-Star user's guide, 0J61, section 5.4)."""
EFFICIENCY = 0.875
"""Of the step-down regulator, 80 to 95 % for most loads (there)."""
PI_A = 0.120
"""Zero 2 W, idle, with Wi-Fi (measured by cnx-software.com, 2021-12-09)."""
MODULE_W = 0.100
"""DWM1001, average (thesis table 1.6, from its data sheet)."""
STALL_A, STALL_AT_V = 1.5, 6.0
"""Of one motor (Pololu, micro metal gearmotor HPCB 6 V); in proportion to the voltage."""
NO_LOAD_A = 0.16
"""Of one motor that turns freely: 80 mA of the 12 V type (Pololu, product 5215), which takes half the current."""
DUTIES = (0.5, 1.0)
"""Of wheels in the air: the thesis measured "at different speeds", and does not say which."""
SETTLE_S = 2.0

THESIS_W = {"Balboa": (0.249, 0.249), "Raspberry Pi": (1.05, 1.43), "Decawave": (1.73, 1.73), "actuators": (2.26, 3.16)}
"""Table 2.5: least and most; each column adds a component to those before."""
THESIS_H = (4.5, 5.0)
"""Autonomy, section 2.4.1."""
SPEED, TURN_RATE = 0.2, 1.5
"""m/s and rad/s of a robot that drives, as `swarm drive` commands."""


@dataclass(frozen=True)
class Sizes:
    """How much the area measures."""

    seconds: float = 60.0
    """Of virtual time in each state."""


FULL = Sizes()
SMOKE = Sizes(2.0)


def rows(sizes: Sizes = FULL) -> Iterator[Row]:
    """Watts of each column, each beside the middle of what the thesis measured; then hours."""
    board = LOGIC_V * BOARD_A / EFFICIENCY
    with_pi = board + LOGIC_V * PI_A / EFFICIENCY
    with_module = with_pi + MODULE_W / EFFICIENCY
    for column, watts in (("Balboa", board), ("Raspberry Pi", with_pi), ("Decawave", with_module)):
        yield _row(f"with {column}", watts, THESIS_W[column])
    for duty in DUTIES:
        name = f"with actuators, wheels free at {100 * duty:.0f} % of duty"
        yield _row(name, with_module + free_w(duty), THESIS_W["actuators"])
    balancing = with_module + motors_w(0.0, 0.0, sizes.seconds)
    driving = with_module + motors_w(SPEED, TURN_RATE, sizes.seconds)
    for state, watts in (("balancing in its place", balancing), ("driving a curve", driving)):
        yield _row(f"with actuators, {state}", watts, THESIS_W["actuators"])
    guard = BatteryGuard(warning=6.6, limit=6.0)
    guard.update(FULL_V, 0.0)
    left = guard.time_left(moving=True)
    assert left is not None
    name = f"autonomy as swarm status shows it, thesis {THESIS_H[0]:g} to {THESIS_H[1]:g} h"
    yield Row(name, left / 3600, "h", fmean(THESIS_H), None)
    for state, watts in (("balancing in its place", balancing), ("driving a curve", driving)):
        yield Row(f"autonomy by this model, {state}", USABLE * CAPACITY_WH / watts, "h", fmean(THESIS_H), None)


def free_w(duty: float) -> float:
    """Both motors with the wheels in the air, as the thesis measured: they take their no-load current, W."""
    return 2 * BATTERY_V * duty * NO_LOAD_A


def motors_w(speed: float, turn_rate: float, seconds: float) -> float:
    """Mean power of both motors of a robot that balances and drives so (m/s, rad/s), W."""
    robot = TimedRobot(scl=100e3, cpu=0.0)
    robot.stand()
    found = []
    for tick in range(round((SETTLE_S + seconds) / PERIOD_S)):
        if speed or turn_rate:
            robot.balancer.drive(speed, turn_rate, 2 * PERIOD_S, robot.now)
        robot.run(PERIOD_S)
        if tick * PERIOD_S >= SETTLE_S:
            found.append(_power(robot))
    assert robot.balancer.mode == "balancing"
    return fmean(found)


def _power(robot: TimedRobot) -> float:
    """What both motors take from the battery at this moment, W."""
    body, model = robot.body, robot.body.model
    stall = STALL_A * BATTERY_V / STALL_AT_V
    lost = NO_LOAD_A / stall - model.friction / model.stall_torque
    watts = 0.0
    for side, simulated in zip((-1, 1), robot.robot.atmega.motors, strict=True):
        wheel = (body.speed + side * body.turn_rate * model.track / 2) / model.wheel_radius - body.tilt_rate
        duty = simulated + math.copysign(lost, wheel)
        watts += max(0.0, BATTERY_V * duty * stall * (duty - wheel / model.free_speed))
    return watts


def _row(name: str, watts: float, measured: tuple[float, float]) -> Row:
    least, most = measured
    shown = f"{least:g}" if least == most else f"{least:g} to {most:g}"
    return Row(f"{name}, thesis {shown} W", watts, "W", fmean(measured), None)
