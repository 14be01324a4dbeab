"""Faults: what keeps the motors off until a command, by name, and how to get out of each.

Every `swarm ...` of a recovery is a command of the laptop's command line; a test compares them.

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
    FELL: "swarm balance stand: it stands up from front or back by itself",
    LIFTED: "put it down, then swarm balance stand",
    CANNOT_STAND: "free the wheels, or hold it upright, then swarm balance stand",
    BUS: "check the ATmega's power and the I2C cables (swarm doctor); once its devices answer: swarm balance stand",
    DEVICE: "mount the part or flash the firmware (swarm flash) that the reason names; then swarm balance stand",
    ESTIMATE: "swarm services restart balancer",
    CLOCK: "swarm services restart balancer: its clock stands still or goes back",
    BATTERY: "charge or change the batteries, then swarm balance stand",
    STOPPED: "take the stop back (swarm arm), then swarm balance stand",
}


class MotorFault(NamedTuple):
    """Why the motors are off."""

    name: str
    reason: str
    """The reason in words."""

    @property
    def recovery(self) -> str:
        """Return what a person has to do."""
        return RECOVERY[self.name]
