"""Commands to the balancer, as they come from the bus: obeyed, or refused with a notice that says why."""

import logging
from collections.abc import Callable

from services.balancer.balancer import Balancer
from services.balancer.link import Message
from swarm.errors import LocalError
from swarm.messages import SetLeds, SetMode, SetParameters, SetVelocity, Stop

_log = logging.getLogger("balancer")


def obey(balancer: Balancer, message: Message, now: float) -> bool:
    """Carry out a command; False where the message is none."""
    match message:
        case SetVelocity(speed, turn_rate, seconds):
            _or_refuse(balancer, "velocity", lambda: balancer.drive(speed, turn_rate, seconds, now))
        case SetMode(mode):
            if _or_refuse(balancer, "mode", lambda: balancer.command(mode, now)):
                _log.info("commanded mode=%s", mode)
        case SetParameters(parameters):
            if _or_refuse(balancer, "parameters", lambda: balancer.change(parameters)):
                _log.info("changed %s", " ".join(f"{name}={value:g}" for name, value in parameters.items()))
        case SetLeds(red, yellow, green, seconds, at):
            _or_refuse(balancer, "leds", lambda: balancer.claim_leds((red, yellow, green), seconds, now, at))
        case _:
            return False
    return True


def halt(balancer: Balancer, stop: Stop) -> bool:
    """Motors off, whatever the robot does; True where that is new."""
    return balancer.stop(f"{stop.reason or 'no reason given'} (by {stop.origin or 'unknown'})")


def moves(message: Message) -> bool:
    """Whether a command may set a robot in motion, or keep it moving."""
    return isinstance(message, SetVelocity) or (isinstance(message, SetMode) and message.mode != "rest")


def _or_refuse(balancer: Balancer, about: str, action: Callable[[], None]) -> bool:
    try:
        action()
    except LocalError as error:
        balancer.notices.append((about, f"refused: {error}"))
        return False
    return True
