"""The controller that a robot's configuration asks for."""

from collections.abc import Callable

from services.balancer.core.control.body import BodyModel
from services.balancer.core.control.controller import Controller
from services.balancer.core.control.drive import Drive, DriveLimits
from services.balancer.core.control.feedback import StateFeedback
from services.balancer.core.control.pololu import POLOLU, THESIS, Pololu
from services.balancer.core.control.regulator import Regulator
from swarm.config.types import Balancing

REGULATORS: dict[str, Callable[[BodyModel], Regulator]] = {
    "lqr": StateFeedback,
    "pololu": lambda body: Pololu(body, POLOLU),
    "thesis": lambda body: Pololu(body, THESIS),
}


def make_controller(body: BodyModel, trim: float, settings: Balancing) -> Controller:
    """Make a controller with its regulator and its limits; `trim` in rad. Raises `LocalError` for a body that cannot
    be balanced."""
    limits = DriveLimits(settings.max_speed, settings.max_turn_rate, settings.acceleration, settings.turn_acceleration)
    return Controller(REGULATORS[settings.controller](body), Drive(body, limits), trim)
