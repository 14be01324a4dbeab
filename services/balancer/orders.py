"""Commands to the balancer, as they come from the bus: obeyed, or refused with a notice that says why."""

import logging
from collections.abc import Callable

from services.balancer.balancer import Balancer
from services.balancer.link import Message
from swarm.errors import LocalError
from swarm.messages import SetLeds, SetMode, SetParameters, SetVelocity, Stop

MAX_REASON = 100
"""Characters of a stop's reason and origin that are kept."""

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
        case Stop(_, origin, reason):
            # It comes back in every state message: others' prose must not make those too large to send.
            why = f"{reason[:MAX_REASON] or 'no reason given'} (by {origin[:MAX_REASON]})"
            if balancer.stop(why):
                _log.warning("stopped: %s", why)
        case _:
            return False
    return True


def _or_refuse(balancer: Balancer, about: str, action: Callable[[], None]) -> bool:
    try:
        action()
    except LocalError as error:
        balancer.notices.append((about, f"refused: {error}"))
        return False
    return True
