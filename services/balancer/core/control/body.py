"""The masses and motors of a Balboa: the numbers behind the controller's model and the simulated body.

Sources: the public MATLAB model labelled Balboa (masses, inertias, lever), Pololu's motor pages (torque, speed; scaled
from the 75:1 motor, so estimates), the estimated mass of Pi, DWM1001-DEV and display (docs/explanation/balancing.md).
"""

from swarm.config.types import Body
from swarm.frozen import frozen

GRAVITY = 9.81

STOCK_GEAR_RATIO = 110.25
"""Motor turns for one wheel turn that torque and speed below are given for: 51.45 x 45/21."""

_BARE_MASS, _BARE_LEVER, _BARE_INERTIA = 0.316, 0.023, 4.44e-4
_PAYLOAD_MASS = {"zero2w": 0.050, "pi4": 0.085}
"""kg of Pi, headers, UWB module and display; a Pi 4 weighs 35 g more than a Zero 2 W. At the
configured 71 mm above the axle it lifts the centre of mass by 6.5 mm with a Zero 2 W, in the middle of the estimate of
5..8 mm."""


@frozen
class BodyModel:
    """A planar two-wheeled pendulum. Torques are those of both wheels together."""

    mass: float
    """Body without wheels, kg."""
    wheel_mass: float
    """Mass of both wheels, kg."""
    lever: float
    """Distance from the axle to the body's centre of mass, m."""
    inertia: float
    """Inertia of the body about its centre of mass, kg m^2."""
    wheel_inertia: float
    """Moment of inertia of both wheels, kg m^2."""
    rotor_inertia: float
    """Inertia of both rotors through the gears (n^2 J), kg m^2: it resists the wheels turning against the body."""
    wheel_radius: float
    """m."""
    counts_per_turn: float
    """Encoder counts for one turn of a wheel against the body."""
    stall_torque: float
    """Torque at duty 1, N m."""
    free_speed: float
    """Speed of a wheel against the body at duty 1, rad/s."""
    friction: float
    """Dry friction, N m."""
    track: float = 0.11
    """Between the wheels, m."""
    yaw_inertia: float = 5.5e-4
    """About the vertical, with the wheels' own, kg m^2 [estimate]."""


def body_model(board: str, body: Body, *, battery: float = 7.4) -> BodyModel:
    """Return the body of a robot with `board` (zero2w or pi4) as configured; `battery` in V."""
    payload = _PAYLOAD_MASS[board] if body.payload is None else body.payload
    mass = _BARE_MASS + payload
    lever = (_BARE_MASS * _BARE_LEVER + payload * body.payload_height) / mass
    # Steiner: the two parts lie apart on the body's long axis.
    inertia = _BARE_INERTIA + _BARE_MASS * payload / mass * (body.payload_height - _BARE_LEVER) ** 2
    gearing = body.gear_ratio / STOCK_GEAR_RATIO
    return BodyModel(
        mass=mass,
        wheel_mass=2 * 0.021,
        lever=lever,
        inertia=inertia,
        wheel_inertia=2 * 2.69e-5,
        rotor_inertia=0.0,  # the source's wheel inertia probably includes it
        wheel_radius=body.wheel_radius,
        counts_per_turn=12 * body.gear_ratio,
        stall_torque=2 * 0.14 * gearing * battery / 6.0,
        free_speed=31.8 / gearing * battery / 6.0,
        friction=4e-3,
        track=body.track,
    )
