"""A Balboa's body as physics: planar pendulum on two wheels, turning by their difference, resting on the floor.

Equations of motion, th from upright and x the axle's way (both of `services.balancer.core.control.body.BodyModel`):

    m11 x'' + (m l cos th - J/r) th'' = tau/r + m l sin(th) th'^2
    (m l cos th - J/r) x'' + m22 th''  = m g l sin th - tau
    tau = ts u - (ts/w0) q' - friction,   q' = x'/r - th'   (wheel against body)

Integrated with fixed steps up to the time asked for: by the clock of whoever looks, so that a controller that is late
finds a body that has fallen meanwhile. Left out: wheel slip, backlash, battery sag, a lying body's friction on the
floor.
"""

import math

from services.balancer.core.control.body import GRAVITY, BodyModel
from services.balancer.core.control.regulator import limited

STEP_S = 0.001
"""Integration step: semi-implicit Euler; the fastest pole is near -56 per second."""
LONGEST_S = 2.0
"""Longest time that is integrated at once, s. A body left alone for longer lies on the floor."""
LAYING_RATE = math.radians(180)
"""Rate at which a hand lays the robot down, rad/s."""
LIFTED_RATE = math.radians(90)
"""Rate at which a hand tips and turns the robot that it holds, rad/s."""
WHEEL_BY_HAND = 6.0
"""Rate at which a hand turns a wheel, rad/s."""
REST_TILT = math.radians(110)
"""Tilt at which the body touches the floor, in front and behind."""


class BalboaBody:
    """State of one body. A hand holds the body upright until the first motor command that is not zero."""

    def __init__(
        self,
        model: BodyModel,
        now: float,
        *,
        place: tuple[float, float, float] = (0.0, 0.0, 0.0),
        tilt: float = 0.0,
        held: bool = True,
    ) -> None:
        """`place` is x, y in m and heading in rad; `tilt` of the centre of mass from upright."""
        self.model = model
        self.x, self.y, self.heading = place
        self.tilt, self.tilt_rate = tilt, 0.0
        self.travel, self.speed = 0.0, 0.0
        self.turn, self.turn_rate = 0.0, 0.0
        self.acceleration, self.tilt_acceleration = 0.0, 0.0
        self.held = held
        self.now = now
        self._left = self._right = 0.0
        self._hand = 0
        self._lifted: tuple[float, float] | None = None
        """For a robot in the hand with its wheels in the air: the tilt to which it is brought, and the angle by which
        it is still to be turned, rad."""
        self._by_hand = [0.0, 0.0]
        """The angle by which a hand still turns each wheel, rad."""
        self._spin = [0.0, 0.0]
        """Rate of each wheel in the air against the body, rad/s."""
        self._prepare()

    def _prepare(self) -> None:
        """Compute the coefficients of the equations, which do not change."""
        model, r = self.model, self.model.wheel_radius
        self._m11 = model.mass + model.wheel_mass + (model.wheel_inertia + model.rotor_inertia) / r**2
        self._m22 = model.inertia + model.mass * model.lever**2 + model.rotor_inertia
        self._ml = model.mass * model.lever
        self._rotor_coupling = model.rotor_inertia / r
        self._damping = model.stall_torque / model.free_speed

    def drive(self, left: float, right: float) -> None:
        """Set both motors' duty, -1..1, from now on."""
        self._left, self._right = left, right
        if left or right:
            self.held = False

    def lift(self, tilt: float, turn: float) -> None:
        """Take the body in the hand, wheels in the air: bring it to this tilt, and turn it left by `turn`, rad."""
        self.held, self._hand = False, 0
        self.speed = self.acceleration = self.tilt_acceleration = 0.0
        self._lifted = tilt, turn

    def roll(self, left: float, right: float) -> None:
        """Turn wheels by hand, rad, forward positive; on a body in the hand."""
        self._by_hand = [left, right]

    def stand(self) -> None:
        """Put the body down upright, held by a hand until the motors run."""
        self._lifted, self._hand = None, 0
        self.tilt = self.tilt_rate = self.speed = self.turn_rate = 0.0
        self.acceleration = self.tilt_acceleration = 0.0
        self.held = True

    def lay(self, side: int) -> None:
        """Take the body and turn it, wheels on their place, until it lies: on its front (1) or back (-1)."""
        self.held, self._lifted = False, None
        self._hand = side

    def carry(self, x: float, y: float, heading: float) -> None:
        """Take the body to another place (m, rad) and lay it on its back there.

        The hand turns it as `lay` does: the gyro feels it, so the balancer knows that it lies and its motors are off
        when the hand lets go. A body that merely appeared there would drive away upright in its estimate.
        """
        self.x, self.y, self.heading = x, y, heading
        self.lay(-1)

    def put_down(self, x: float, y: float, heading: float, tilt: float) -> None:
        """Lie where it fell over: at this place (m), to the side it leaned to."""
        self.held, self._lifted = False, None
        self.x, self.y, self.heading = x, y, heading
        self.tilt = tilt
        self._lie_down()

    def push(self, momentum: float) -> None:
        """Hit the body at the height of its centre of mass, forward positive, N s. A hand that held it lets go.

        A body in the hand is not hit.
        """
        if self._lifted is not None:
            return
        self.held = False
        # The impulse acts on both coordinates: its generalized momenta are P and P l cos(th).
        m12 = self._ml * math.cos(self.tilt) - self._rotor_coupling
        determinant = self._m11 * self._m22 - m12 * m12
        turning = momentum * self.model.lever * math.cos(self.tilt)
        self.speed += (momentum * self._m22 - turning * m12) / determinant
        self.tilt_rate += (turning * self._m11 - momentum * m12) / determinant

    def knock(self, momentum: float, dx: float, dy: float) -> None:
        """Be hit by another robot: slide aside (m, the wheels do not turn), and take the momentum forward, N s."""
        if self._lifted is None and not self.held:
            self.x += dx
            self.y += dy
            self.push(momentum)

    def wheel_angles(self) -> tuple[float, float]:
        """Return the angles of the left and right wheel against the body since the start, rad. Encoders count them."""
        half = self.turn * self.model.track / 2
        r = self.model.wheel_radius
        return (self.travel - half) / r - self.tilt, (self.travel + half) / r - self.tilt

    def advance(self, now: float) -> None:
        """Integrate up to `now`. A time before the last one does nothing."""
        steps = int((now - self.now) / STEP_S)
        if steps <= 0:
            return
        if self.held:
            self.now += steps * STEP_S
            return
        if self._lifted is not None:
            for _ in range(min(steps, int(LONGEST_S / STEP_S))):
                self._in_the_hand(STEP_S)
            self.now += steps * STEP_S
            return
        if self._hand:
            self._turn_by_hand(steps * STEP_S)
            self.now += steps * STEP_S
            return
        limit = int(LONGEST_S / STEP_S)
        self._integrate(min(steps, limit))
        if steps > limit and not (self._left or self._right):
            self._lie_down()
        self.now += steps * STEP_S

    def _in_the_hand(self, dt: float) -> None:
        """Tip and turn the body as the hand does, and turn each wheel by its motor or by the hand."""
        assert self._lifted is not None
        target, turn = self._lifted
        tip = limited(target - self.tilt, LIFTED_RATE * dt)
        turned = limited(turn, LIFTED_RATE * dt)
        self._lifted = target, turn - turned
        self.tilt, self.tilt_rate = self.tilt + tip, tip / dt
        self.heading, self.turn_rate = self.heading + turned, turned / dt
        angles = [self._wheel_in_the_air(side, duty, dt) for side, duty in enumerate((self._left, self._right))]
        # Of the sums behind the encoders: the body's own turning moves no wheel against it.
        radius = self.model.wheel_radius
        self.travel += radius * (tip + (angles[0] + angles[1]) / 2)
        self.turn += radius * (angles[1] - angles[0]) / self.model.track

    def _wheel_in_the_air(self, side: int, duty: float, dt: float) -> float:
        """Return by how much a wheel turns against the body, rad: half of the torques and inertias each."""
        model = self.model
        if self._by_hand[side]:
            angle = limited(self._by_hand[side], WHEEL_BY_HAND * dt)
            self._by_hand[side] -= angle
            self._spin[side] = 0.0
            return angle
        inertia = (model.wheel_inertia + model.rotor_inertia) / 2
        spin = self._spin[side] + dt * model.stall_torque / 2 * duty / inertia
        spin /= 1 + dt * self._damping / 2 / inertia
        friction = dt * model.friction / 2 / inertia
        self._spin[side] = spin = 0.0 if abs(spin) <= friction else spin - math.copysign(friction, spin)
        return spin * dt

    def _turn_by_hand(self, seconds: float) -> None:
        """Turn the body as a hand lays it down. The motors may run meanwhile: the hand holds the wheels, too."""
        self.speed = self.turn_rate = 0.0
        self.acceleration = self.tilt_acceleration = 0.0
        target = self._hand * REST_TILT
        way = target - self.tilt
        step = math.copysign(min(abs(way), LAYING_RATE * seconds), way)
        self.tilt += step
        self.tilt_rate = math.copysign(LAYING_RATE, way)
        if self.tilt == target or abs(way) <= LAYING_RATE * seconds:
            self._hand = 0
            self.tilt = target
            self._lie_down()

    def _lie_down(self) -> None:
        if abs(self.tilt) < REST_TILT:
            self.tilt = math.copysign(REST_TILT, self.tilt)
        self.tilt_rate = self.speed = self.turn_rate = 0.0
        self.acceleration = self.tilt_acceleration = 0.0

    def _integrate(self, steps: int) -> None:
        """Integrate so many steps. A robot takes some thousand steps a second, hence everything is in local names."""
        model = self.model
        r, half_track = model.wheel_radius, model.track / 2
        m11, m22, ml, rotor = self._m11, self._m22, self._ml, self._rotor_coupling
        weight, damping, dt = ml * GRAVITY, self._damping, STEP_S
        tilt, rate, speed = self.tilt, self.tilt_rate, self.speed
        heading, turn_rate = self.heading, self.turn_rate
        x, y, travel, turn = self.x, self.y, self.travel, self.turn
        drive = model.stall_torque * (self._left + self._right) / 2
        # Turning: half of the motors' torques each, on a lever of half the track; friction is shared likewise.
        turn_drive = model.stall_torque * (self._right - self._left) / 2 / r * half_track / model.yaw_inertia
        turn_damping = 1 + dt * damping * (half_track / r) ** 2 / model.yaw_inertia
        turn_friction = dt * model.friction / 2 / r * half_track / model.yaw_inertia
        friction = model.friction
        sin, cos = math.sin, math.cos
        a_x = a_th = 0.0
        m11_m22, m22_r = m11 * m22, m22 / r
        ahead, left = cos(heading), sin(heading)
        for _ in range(steps):
            s = sin(tilt)
            m12 = ml * cos(tilt) - rotor
            determinant = m11_m22 - m12 * m12
            wheel_rate = speed / r - rate
            torque = drive - damping * wheel_rate
            f1, f2 = torque / r + ml * s * rate * rate, weight * s - torque
            a_x, a_th = (f1 * m22 - f2 * m12) / determinant, (f2 * m11 - f1 * m12) / determinant
            # Dry friction takes what would stop the wheel against the body within this step, or all it has.
            x_torque, th_torque = (m22_r + m12) / determinant, -(m11 + m12 / r) / determinant
            stopping = (wheel_rate + dt * (a_x / r - a_th)) / (dt * (x_torque / r - th_torque))
            loss = friction if stopping > friction else -friction if stopping < -friction else stopping
            a_x -= loss * x_torque
            a_th -= loss * th_torque
            if (tilt >= REST_TILT and a_th > 0.0) or (tilt <= -REST_TILT and a_th < 0.0):
                # The floor holds the body: only the wheels move.
                torque = drive - damping * speed / r
                stopping = speed * m11 * r / dt + torque
                loss = friction if stopping > friction else -friction if stopping < -friction else stopping
                a_x, a_th = (torque - loss) / r / m11, 0.0
            speed += dt * a_x
            rate += dt * a_th
            tilt += dt * rate
            if tilt > REST_TILT:
                tilt = REST_TILT
                rate = min(rate, 0.0)
            elif tilt < -REST_TILT:
                tilt = -REST_TILT
                rate = max(rate, 0.0)
            turn_rate = (turn_rate + dt * turn_drive) / turn_damping
            if turn_rate > turn_friction:
                turn_rate -= turn_friction
            elif turn_rate < -turn_friction:
                turn_rate += turn_friction
            else:
                turn_rate = 0.0
            way = dt * speed
            travel += way
            if turn_rate:
                turn += dt * turn_rate
                heading += dt * turn_rate
                ahead, left = cos(heading), sin(heading)
            x += way * ahead
            y += way * left
        self.tilt, self.tilt_rate, self.speed = tilt, rate, speed
        self.acceleration, self.tilt_acceleration = a_x, a_th
        self.x, self.y, self.heading, self.turn_rate = x, y, heading, turn_rate
        self.travel, self.turn = travel, turn
