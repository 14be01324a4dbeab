"""A hand on a simulated robot: tells its body what a person does.

Each body of a running simulation listens at its door, a datagram socket in the robot's runtime directory; the balancer
learns of it as a real one would, through its sensors.
"""

import socket
from pathlib import Path

from swarm.core.hands import DOOR, Act, check, pack
from swarm.errors import LocalError
from swarm.paths import socket_path


def do(robot: Path, act: Act) -> None:
    """Do it to the simulated robot with the runtime directory `robot`; `LocalError` where its body is not there."""
    datagram = pack(check(act))
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sock:
        sock.settimeout(1.0)
        try:
            sock.sendto(datagram, str(socket_path(robot, DOOR)))
        except OSError as error:
            raise LocalError(f"the body of {robot.name} is not running at this moment ({error.strerror})") from None
