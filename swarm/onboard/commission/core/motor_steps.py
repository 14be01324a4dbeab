"""Steps with motors: one at a time at low power, stop and watchdog, wheels that follow the tilt, and standing."""

import math
from collections.abc import Mapping
from statistics import fmean

from swarm.messages import Arm, SetMode, Stop, TryMotors
from swarm.onboard.commission.core.procedure import Desk, Script, StepError
from swarm.process.text import printable

DUTY = 0.15
"""Share of full power in the motor tests; the balancer accepts at most 0.2 without balancing."""
TURN_S = 1.0
MOVED_M = 0.02
"""Least way of a wheel in a second at that duty, m: a tenth of the way of a free wheel."""
WRONG_M = 0.015
"""Way in the wrong direction after which a wheel is stopped at once, m."""
STILL = 0.02
"""Speed below which a wheel stands, m/s."""
STOP_S = 0.5
REASON = "swarm commission"
"""The reason of the stop that is tried."""
WATCHDOG_S = 0.8
"""Seconds after the single command within which the wheels must stop: the ATmega waits 0.2 s, and then the wheels run
out."""
TIPPED = 0.12
"""Tilt beyond which the robot counts as tipped over, rad."""
TIP_S = 60.0
FOLLOW_S = 0.6
STAND_S = 15.0
CALM_S = 2.0
MEASURED_S = 10.0
LIE_S = 8.0


def motors(desk: Desk) -> Script:
    """Check that each motor turns its own wheel, forward as forward. An earlier step has checked the encoders."""
    yield from desk.confirm("lift-upright", "Hold it upright in your hand, wheels free and in the air. A or Enter.")
    for side, name in enumerate(("left", "right")):
        before = desk.robot.rolled()
        desk.say(f"the {name} wheel turns forward for a second, slowly")
        desk.send(TryMotors(DUTY * (side == 0), DUTY * (side == 1), TURN_S))

        def wrong(before: tuple[float, float] = before, side: int = side) -> bool:
            ways = desk.robot.rolled_since(before)
            return ways[side] < -WRONG_M or abs(ways[1 - side]) > WRONG_M

        if (yield from desk.until(wrong, TURN_S + 0.5)):
            desk.send(SetMode("rest"))
        ways = desk.robot.rolled_since(before)
        own, other = ways[side], ways[1 - side]
        desk.figures[f"{name}_m_s"] = round(own / TURN_S, 3)
        if abs(other) > max(WRONG_M, abs(own)):
            raise StepError(
                "the motors are swapped: each turns the other wheel",
                "connect each motor to the pads of its own side of the board",
            )
        if own < -WRONG_M:
            raise StepError(f"the {name} motor is reversed: forward it turns backward", _wires(desk, name))
        if own < MOVED_M:
            raise StepError(f"the {name} motor does not turn its wheel", "check its solder joints; is the wheel free?")
        yield from desk.wait(0.5)


def _wires(desk: Desk, name: str) -> str:
    table = f"[balancing.robots.{desk.subject.robot}]"
    return f"set flip_{name}_motor = true in {table} of swarm.toml, and swarm deploy; or swap the motor's two wires"


def stop(desk: Desk) -> Script:
    """Check that a stop ends the motors' motion at once, and holds until it is taken back."""
    yield from desk.confirm("lift-upright", "Wheels free, in your hand: they turn, then are stopped. A or Enter.")
    yield from _turning(desk, "turn")
    yield from desk.wait(0.4)
    robot = desk.subject.robot
    known = desk.robot.stopped
    if desk.robot.mode == "fault" or (known is not None and known.stopped):
        # This step's stop would take the place of one that somebody has just given on this robot.
        raise StepError("it was stopped before this step did so", "swarm status names who; swarm arm, when all is well")
    desk.send(Stop(desk.now, robot, REASON))
    begin = desk.now
    stopped = yield from desk.until(lambda: desk.robot.wheel_speed() < STILL and desk.robot.mode == "fault", STOP_S)
    desk.figures["stopped_s"] = round(desk.now - begin, 3)
    yield from desk.wait(0.2)  # the mesh notes another stop of this robot up to 0.1 s later
    known = desk.robot.stopped
    theirs = {} if known is None or known.by == {robot: REASON} else known.by
    if not theirs:
        desk.send(Arm(desk.now, REASON))
    if not stopped:
        desk.send(SetMode("rest"))
        raise StepError("a stop does not stop the wheels", "swarm services restart balancer; swarm doctor")
    if theirs:
        raise StepError(f"somebody else has stopped the swarm: {_named(theirs)}", "swarm arm, when all is well")
    yield from desk.wait(1.0)
    desk.send(SetMode("rest"))
    if not (yield from desk.until(lambda: desk.robot.mode == "idle", 3.0)):
        raise StepError("the stop is not taken back", "swarm arm; is another robot stopped?")


def _named(stops: Mapping[str, str]) -> str:
    return ", ".join(f"{printable(robot)} ({printable(reason)})" for robot, reason in stops.items())


def watchdog(desk: Desk) -> Script:
    """Check that the ATmega stops the motors by itself when their commands cease."""
    yield from desk.confirm("lift-upright", "Wheels free again: they turn, and must stop by themselves. A or Enter.")
    begin = desk.now
    yield from _turning(desk, "watchdog")
    stopped = yield from desk.until(lambda: desk.robot.wheel_speed() < STILL, WATCHDOG_S)
    desk.figures["stopped_s"] = round(desk.now - begin, 3)
    desk.send(SetMode("rest"))
    if not stopped:
        raise StepError("the ATmega's watchdog does not stop the motors", "flash this release's firmware: swarm flash")


def _turning(desk: Desk, kind: str) -> Script:
    desk.send(TryMotors(DUTY, DUTY, 3.0, kind))
    if not (yield from desk.until(lambda: STILL < desk.robot.wheel_speed() < math.inf, 1.0)):
        raise StepError("the wheels did not turn", "try again; else the motors step has more to say")


def held(desk: Desk) -> Script:
    """Check at low power, in the hand, that the wheels run to the side to which the robot tips."""
    yield from desk.confirm("lift-upright", "Hold it upright in your hand, wheels free: they follow it. A or Enter.")
    for name, sign in (("forward", 1), ("backward", -1)):
        desk.prompt(f"tip-a-bit-{name}", f"Tip it {name} by some 15 degrees, and hold it there.")
        renewed, end = -math.inf, desk.now + TIP_S
        while not _tipped(desk, sign):
            if desk.now >= end:
                raise StepError(f"it was not tipped {name}", "tip it by 15 degrees at least")
            if desk.now >= renewed + 5.0:
                renewed = desk.now
                desk.send(TryMotors(0.0, 0.0, 10.0, "tilt"))
            yield
        yield from desk.wait(0.5)
        before = desk.robot.rolled()
        yield from desk.wait(FOLLOW_S)
        after = desk.robot.rolled()
        ways = [sign * (new - old) for old, new in zip(before, after, strict=True)]
        desk.figures[f"{name}_m"] = round(min(ways), 3)
        if min(ways) < MOVED_M / 2:
            raise StepError(
                f"tipped {name}, the wheels do not run {name}",
                "begin again: imu, encoders, motors; trim in [body]",
            )
    desk.send(SetMode("rest"))
    yield from desk.until(lambda: desk.robot.mode == "idle", 3.0)


def _tipped(desk: Desk, sign: int) -> bool:
    return desk.robot.state is not None and sign * desk.robot.state.tilt > TIPPED


def standing(desk: Desk) -> Script:
    """Check that the robot balances, first in the hand, then alone on the floor."""
    robot = desk.robot
    text = "Stand it upright on the floor, wheels on the ground, and hold it loosely. A or Enter: it balances."
    yield from desk.confirm("stand-on-floor", text)
    desk.send(SetMode("stand"))
    if not (yield from desk.until(lambda: robot.mode == "balancing", STAND_S)):
        raise _fallen(desk, "it does not begin to balance")
    desk.say("it balances: let it go, and leave it alone")
    yield from desk.wait(CALM_S)
    first = robot.state
    robot.states.clear()
    fell = yield from desk.until(lambda: robot.mode != "balancing", MEASURED_S)
    states, last = list(robot.states), robot.state
    if fell or not states or first is None or last is None:
        raise _fallen(desk, "it has fallen")
    tilts = [state.tilt for state in states]
    trim = fmean(tilts)
    desk.figures |= {
        "trim_rad": round(trim, 4),
        "tilt_rms_deg": round(math.degrees(math.sqrt(fmean((tilt - trim) ** 2 for tilt in tilts))), 3),
        "duty_rms": round(math.sqrt(fmean(state.duty_left**2 for state in states)), 3),
        "late_p99_ms": round(1e3 * max(state.late_p99 for state in states), 3),
        "missed": last.missed - first.missed,
        "bus_errors": last.bus_errors - first.bus_errors,
        "battery_v": None if last.battery is None else round(last.battery, 2),
    }
    desk.say("it lies down now: catch it, or let it")
    desk.send(SetMode("lie"))
    yield from desk.until(lambda: robot.mode == "idle", LIE_S)


def _fallen(desk: Desk, text: str) -> StepError:
    fault = desk.robot.fault
    if fault.name:
        return StepError(f"{text}: {fault.reason}", f"trim and gear_ratio in swarm.toml; {fault.recovery}")
    return StepError(text, "trim and gear_ratio in swarm.toml, the wheels' grip; hold it upright when it begins")
