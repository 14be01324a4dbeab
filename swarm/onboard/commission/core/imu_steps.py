"""Steps that find a part that is mounted the wrong way, by hand alone: IMU and encoders."""

import math
from collections.abc import Generator

from swarm.messages import ImuRequest, SetMode
from swarm.onboard.commission.core.device_steps import LAY_BACK
from swarm.onboard.commission.core.procedure import Desk, Script, StepError
from swarm.onboard.commission.core.robot_view import ImuMean

GRAVITY = 9.81
IMU_RATE = 50.0
SAMPLE_S = 1.0
ANGLE = math.radians(40)
"""Largest error of a posture or a turn by hand, rad: a hand is no gauge."""
ZERO_TRIES = 5
ZERO_S = 4.0
LEAST_TURN = math.radians(30)
LYING = math.radians(110)
ROLLED_M = 0.12
"""Way of a wheel in half a turn, m."""
ROLL_S = 60.0
DONE = "A or Enter when it is done."
FORWARD = "Forward is the way in which the battery cover faces."
"""Pololu's user's guide 0J70, section 3.4."""
FLASH = "flash this release's firmware: swarm flash"
UP, AXLE, BACK = range(3)
"""Axes of the IMU: X up, Y to the left along the axle, Z backward."""

MOUNTING = "the IMU is part of the Balboa's board: mount that board (or the IMU of your own) the right way round"


def imu(desk: Desk) -> Script:
    """Check that the axes of the IMU's accelerometer and gyro are those of the body."""
    yield from desk.confirm("lay-back", LAY_BACK)
    yield from _find_zero(desk)
    back = yield from _mean(desk)
    front = yield from _sample(desk, "lay-front", "Lay it on its front, its battery cover down.")
    upright = yield from _sample(desk, "lift-upright", "Take it in your hand and hold it upright, wheels in the air.")
    tilts = {
        name: math.atan2(mean.acceleration[BACK], mean.acceleration[UP])
        for name, mean in (("back", back), ("front", front), ("upright", upright))
    }
    desk.figures |= {f"{name}_deg": round(math.degrees(tilt), 1) for name, tilt in tilts.items()}
    desk.figures |= {
        "gyro_zero_rad_s": [round(rate, 5) for rate in back.gyro],
        "gyro_noise_rad_s": round(max(back.gyro_noise), 6),
        "acceleration_noise_m_s2": round(max(back.acceleration_noise), 5),
    }
    if any(not 0.8 * GRAVITY < math.hypot(*mean.acceleration) < 1.2 * GRAVITY for mean in (back, front, upright)):
        raise StepError("the accelerometer does not feel 1 g at rest", "hold the robot still; else the IMU is broken")
    if upright.acceleration[UP] < 0.0:
        raise StepError("the IMU is mounted upside down: upright it feels gravity from above", MOUNTING)
    if _near(tilts["back"], LYING) and _near(tilts["front"], -LYING):
        raise StepError(
            "the IMU is mounted backward: it takes the robot's back for its front (or it was laid the other way round)",
            MOUNTING,
        )
    for name, angle in (("back", -LYING), ("front", LYING), ("upright", 0.0)):
        if not _near(tilts[name], angle):
            raise StepError(
                f"{name}: the IMU sees {math.degrees(tilts[name]):.0f} degrees, expected {math.degrees(angle):.0f}",
                "hold it as asked; else the IMU is not mounted along the body's axes",
            )
    yield from _gyro(desk, back.gyro)


def _gyro(desk: Desk, zero: tuple[float, float, float]) -> Script:
    robot = desk.robot
    _listen(desk)
    yield from desk.confirm(
        "tip-forward", f"Tip it slowly forward by a quarter turn, as if it fell on its face. {DONE}"
    )
    tipped, by_gyro = _tilt_of(desk), robot.turned(AXLE, zero[AXLE])
    _listen(desk)
    yield from desk.confirm("lift-upright", f"Hold it upright again. {DONE}")
    _listen(desk)
    yield from desk.confirm("turn-left", f"Turn it slowly to the left by a quarter turn, upright. {DONE}")
    turned = robot.turned(UP, zero[UP])
    desk.figures |= {
        "tipped_deg": round(math.degrees(tipped), 1),
        "tipped_by_gyro_deg": round(math.degrees(by_gyro), 1),
        "turned_by_gyro_deg": round(math.degrees(turned), 1),
    }
    if tipped < LEAST_TURN or abs(by_gyro) < LEAST_TURN / 2 or abs(turned) < LEAST_TURN:
        raise StepError("it was not turned far enough to tell", "a quarter turn each, in one go")
    if by_gyro < 0.0:
        raise StepError(
            "the IMU is mirrored: its gyro turns the other way than its accelerometer",
            "another part than an LSM6DS33 or LSM6DSO answers, or its axes are set otherwise: change the IMU",
        )
    if turned < 0.0:
        raise StepError("the gyro's vertical axis is reversed: to the left it turns right", MOUNTING)


def encoders(desk: Desk) -> Script:
    """Check that each encoder counts its own wheel, forward as forward. A person turns the wheels, so no motor is
    needed."""
    yield from desk.confirm("lift-upright", "Hold it upright in your hand, wheels in the air. A or Enter.")
    for side, name in enumerate(("left", "right")):
        before = desk.robot.rolled()
        desk.prompt(f"roll-{name}", f"Turn the {name} wheel forward by hand, a whole turn. {FORWARD}")

        def moved(before: tuple[float, float] = before) -> bool:
            return max(map(abs, desk.robot.rolled_since(before))) > ROLLED_M

        if not (yield from desk.until(moved, ROLL_S)):
            raise StepError(
                f"no encoder counts when the {name} wheel turns",
                f"does the magnetic disc sit on the shaft of the {name} motor, beside the sensors on the board?",
            )
        ways = desk.robot.rolled_since(before)
        own, other = ways[side], ways[1 - side]
        desk.figures[f"{name}_m"] = round(own, 3)
        if abs(other) > abs(own):
            raise StepError(
                "the encoders are swapped: each counts the other wheel",
                f"did you turn the {name} wheel, as seen from behind the robot? else {FLASH}",
            )
        if own < 0.0:
            raise StepError(
                f"the {name} encoder is reversed: forward it counts backward",
                f"did you turn the wheel forward? {FORWARD} Else {FLASH}",
            )
        yield from desk.wait(1.5)


def _sample(desk: Desk, what: str, text: str) -> Generator[None, None, ImuMean]:
    """Have the robot held so, and return what the IMU shows for a second."""
    yield from desk.confirm(what, f"{text} {DONE}")
    return (yield from _mean(desk))


def _find_zero(desk: Desk) -> Script:
    """Have the balancer find its gyro's zero anew: the IMU may have been mounted otherwise since it did."""
    notices = desk.robot.notices
    for _ in range(ZERO_TRIES):
        notices.clear()
        desk.send(SetMode("calibrate"))
        if (yield from desk.until(lambda: any(each.about in ("calibrate", "mode") for each in notices), ZERO_S)):
            if any(each.about == "calibrate" and each.text == "done" for each in notices):
                return
            yield from desk.wait(0.5)
    why = "".join(f": {each.text}" for each in [*notices][-1:])
    raise StepError(
        f"the gyro's zero is not found{why}", "leave it alone; after another IMU: swarm services restart balancer"
    )


def _mean(desk: Desk) -> Generator[None, None, ImuMean]:
    """Return what the IMU shows for a second."""
    _listen(desk)
    yield from desk.wait(SAMPLE_S)
    if len(desk.robot.imu) < SAMPLE_S * IMU_RATE / 4:
        raise StepError("the balancer tells no samples of the IMU", "swarm doctor: does the IMU answer?")
    return desk.robot.imu_mean()


def _listen(desk: Desk) -> None:
    """Forget samples of before, and have more of them told for a minute."""
    desk.robot.imu.clear()
    desk.send(ImuRequest(IMU_RATE, 60.0))


def _tilt_of(desk: Desk) -> float:
    """Return the tilt by gravity in the newest sample, rad; 0 without any."""
    if not desk.robot.imu:
        return 0.0
    acceleration = desk.robot.imu[-1].acceleration
    return math.atan2(acceleration[BACK], acceleration[UP])


def _near(angle: float, expected: float) -> bool:
    return abs(math.remainder(angle - expected, math.tau)) < ANGLE
