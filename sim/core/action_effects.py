"""The effects of a person's actions on the simulated robot."""

from services.balancer.core.devices import balboa, display, imu
from sim.core.actions import (
    BUTTONS,
    BodyPlace,
    Carry,
    Knock,
    Lay,
    Lift,
    Miswire,
    Press,
    Push,
    Roll,
    SimulationAction,
    Unplug,
)
from sim.core.devices import Device, SimulatedRobot

ADDRESSES = {"imu": imu.ADDRESS, "atmega": balboa.ADDRESS, "display": display.ADDRESS}


class ActionEffects:
    """Acts on one robot; `handle_timer` lets buttons go again."""

    def __init__(self, robot: SimulatedRobot) -> None:
        self._robot = robot
        self._until = [0.0] * len(BUTTONS)
        self._unplugged: dict[int, Device] = {}

    def do(self, act: SimulationAction, now: float) -> None:
        """Do an action now."""
        body = self._robot.body
        match act:
            case Press(button, seconds):
                self._until[BUTTONS.index(button)] = now + seconds
                self.handle_timer(now)
            case Push(impulse):
                body.push(impulse)
            case Knock(impulse, dx, dy):
                body.knock(impulse, dx, dy)
            case Lay(side):
                body.lay(1 if side == "front" else -1)
            case Carry(x, y, heading):
                body.carry(x, y, heading)
            case Lift(tilt, turn, down):
                if down:
                    body.stand()
                else:
                    body.lift(tilt, turn)
            case Roll(wheel, angle):
                body.roll(angle if wheel == "left" else 0.0, angle if wheel == "right" else 0.0)
            case Miswire(part, back):
                self._robot.miswire(part, back=back)
            case Unplug(device, back):
                self._plug(ADDRESSES[device], back=back)
            case BodyPlace(x, y, heading, tilt, held):
                if not held:
                    body.put_down(x, y, heading, tilt)

    def _plug(self, address: int, *, back: bool) -> None:
        """Move a device from the bus into the hand, or the other way."""
        source, target = self._robot.devices, self._unplugged
        if back:
            source, target = target, source
        if address in source:
            target[address] = source.pop(address)

    def handle_timer(self, now: float) -> None:
        """Release the buttons that were held long enough."""
        self._robot.atmega.press(sum(1 << bit for bit, until in enumerate(self._until) if now < until))
