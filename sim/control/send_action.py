"""A hand on a simulated robot: tells its body what a person does.

Each body of a running simulation listens on a datagram socket in the robot's runtime directory; the balancer
learns of it as a real one would, through its sensors.
"""

from pathlib import Path

from sim.control import datagrams
from sim.core.actions import BODY_SOCKET, SimulationAction, check, pack


def do(robot: Path, act: SimulationAction) -> None:
    """Do it to the simulated robot with the runtime directory `robot`; `LocalError` where its body is not there."""
    datagrams.send(robot, BODY_SOCKET, pack(check(act)), f"the body of {robot.name} is not running at this moment")
