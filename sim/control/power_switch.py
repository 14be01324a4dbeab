"""The power switch of a simulated robot: the simulation ends all its processes at once, and boots it later.

What a reboot costs a real robot is gone here, too: the runtime directory, as /run/swarm would be. What was on its disk
(`DISK` in that directory, and the recordings) is kept.
"""

from pathlib import Path

from sim.control import datagrams
from swarm.errors import LocalError
from swarm.frozen import frozen
from swarm.messages.codec import decode, encode

SOCKET = "power.sock"
"""The socket in the run directory at which the simulation listens."""

DISK = "disk"
"""A simulated robot's state directory, in its runtime directory."""

MAX_OFF_S = 600.0


@frozen
class Reboot:
    """A request to the simulation to reboot a robot."""

    robot: str
    seconds: float
    """Seconds until its services are started again: the time of a boot."""


def reboot(run_dir: Path, robot: str, seconds: float) -> None:
    """Switch a robot off, and on again after `seconds`. Raises `LocalError` where no simulation listens."""
    if not 0.0 <= seconds <= MAX_OFF_S:
        raise LocalError(f"a robot is off for 0 to {MAX_OFF_S:g} s, not {seconds:g}")
    datagrams.send(run_dir, SOCKET, encode(Reboot(robot, seconds)), f"the simulation in {run_dir} does not listen")


def unpack(datagram: bytes) -> Reboot:
    """Unpack what `reboot` has sent. Raises `PayloadError`."""
    return decode(Reboot, datagram, SOCKET)
