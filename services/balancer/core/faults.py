"""Faults: what keeps the motors off until a command, by name, and how to get out of each.

The first fault stays: what follows it is mostly its consequence. None goes by itself.
"""

from typing import NamedTuple

FELL = "fell"
LIFTED = "lifted"
CANNOT_STAND = "cannot_stand"
BUS = "bus"
DEVICE = "device"
ESTIMATE = "estimate"
CLOCK = "clock"
BATTERY = "battery"
STOPPED = "stopped"

RECOVERY = {
    FELL: "set/mode stand: it stands up from front or back by itself",
    LIFTED: "put it down, then set/mode stand",
    CANNOT_STAND: "free the wheels, or hold it upright, then set/mode stand",
    BUS: "check the ATmega's power and the I2C cables; once its devices answer: set/mode stand",
    DEVICE: "mount the part or flash the firmware that the reason names; once it answers: set/mode stand",
    ESTIMATE: "restart the balancer",
    CLOCK: "restart the balancer: its clock stands still or goes back",
    BATTERY: "charge or change the batteries, then set/mode stand",
    STOPPED: "take the stop back (swarm arm), then set/mode stand",
}


class MotorFault(NamedTuple):
    """Why the motors are off."""

    name: str
    reason: str
    """In words."""

    @property
    def recovery(self) -> str:
        """What a person has to do."""
        return RECOVERY[self.name]
