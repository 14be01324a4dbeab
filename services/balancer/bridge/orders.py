"""Commands to the balancer, as they come from the bus: obeyed, or refused with a notice that says why."""

import logging
from collections.abc import Callable, Mapping
from typing import Protocol

from services.balancer.bridge.link import LoopMessage
from services.balancer.core.devices.leds import Shown
from swarm.errors import LocalError
from swarm.messages import SetLeds, SetMode, SetParameters, SetVelocity, Stop, TryMotors


class Obedient(Protocol):
    """A balancer that obeys commands. Its methods raise `LocalError` where they cannot obey."""

    def drive(self, speed: float, turn_rate: float, seconds: float, now: float) -> None:
        """Drive forward (m/s) and turn left (rad/s) for a time."""

    def command(self, mode: str, now: float) -> None:
        """Change the mode: `stand`, `rest`, `lie` or `calibrate`."""

    def test_motors(self, request: TryMotors, now: float) -> None:
        """Turn the wheels at low power for a time, without balancing."""

    def change(self, parameters: Mapping[str, float]) -> None:
        """Change parameters, all or none."""

    def claim_leds(self, leds: Shown, seconds: float, now: float, at: float | None = None) -> None:
        """Show what an app wants, for a time or until the next mode command; from the time `at` on, or at once."""

    def stop(self, reason: str) -> bool:
        """Motors off until the next command; True where that is new."""

    def notice(self, about: str, text: str) -> None:
        """Tell people something about a command."""


def obey(balancer: Obedient, message: LoopMessage, now: float, log: logging.Logger) -> bool:
    """Carry out a command; False where the message is none."""
    match message:
        case SetVelocity(speed, turn_rate, seconds):
            _or_refuse(balancer, "velocity", lambda: balancer.drive(speed, turn_rate, seconds, now))
        case SetMode(mode):
            if _or_refuse(balancer, "mode", lambda: balancer.command(mode, now)):
                log.info("commanded mode=%s", mode)
        case TryMotors():
            _or_refuse(balancer, "motors", lambda: balancer.test_motors(message, now))
        case SetParameters(parameters):
            if _or_refuse(balancer, "parameters", lambda: balancer.change(parameters)):
                log.info("changed %s", " ".join(f"{name}={value:g}" for name, value in parameters.items()))
        case SetLeds(red, yellow, green, seconds, at):
            _or_refuse(balancer, "leds", lambda: balancer.claim_leds((red, yellow, green), seconds, now, at))
        case _:
            return False
    return True


def halt(balancer: Obedient, stop: Stop) -> bool:
    """Motors off, whatever the robot does; True where that is new."""
    return balancer.stop(f"{stop.reason or 'no reason given'} (by {stop.origin or 'unknown'})")


def moves(message: LoopMessage) -> bool:
    """Return whether a command may set a robot in motion, or keep it moving."""
    return isinstance(message, SetVelocity | TryMotors) or (isinstance(message, SetMode) and message.mode != "rest")


def _or_refuse(balancer: Obedient, about: str, action: Callable[[], None]) -> bool:
    try:
        action()
    except LocalError as error:
        balancer.notice(about, f"refused: {error}")
        return False
    return True
