"""Cutting the simulated radio: the process that is the radio is told, or each end of a link by a datagram to its mesh's
`sim:` transport."""

import socket
from pathlib import Path

import msgpack

from services.mesh.links import slots
from sim.disturbances import Cut
from swarm.errors import LocalError

SOCKET = "air.sock"


def cut(run_dir: Path, robot: str, peer: str, seconds: float) -> None:
    """Cut the radio between two robots of a simulation for some seconds; 0 mends it. Raises `LocalError`."""
    radio = run_dir / slots.RADIO_SOCKET
    if radio.exists():
        try:
            slots.ask(radio, slots.RadioCut(robot, peer, float(seconds))).close()
        except OSError as error:
            raise LocalError(f"not cut: the radio is not running at this moment ({error.strerror})") from None
        return
    problem = ""
    for end, other in ((robot, peer), (peer, robot)):
        try:
            silence(run_dir, end, other, seconds)
        except OSError as error:
            problem = problem or f"not cut: the mesh of {end} is not running at this moment ({error.strerror})"
    if problem:
        raise LocalError(problem)


def silence(run_dir: Path, robot: str, peer: str, seconds: float) -> None:
    """Let nothing pass between `robot` and `peer` at the robot's end; a cut link wants both ends told.

    Raises OSError where the robot's mesh is not there.
    """
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sock:
        sock.sendto(msgpack.packb({"cut": peer, "seconds": seconds}), str(run_dir / robot / SOCKET))


class DueCuts:
    """The cuts of a run whose time has come.

    While the radio, or a mesh at an end of the link, is being restarted nobody can be told of a cut. It is tried again
    until it would be over, and ends when it would have ended.
    """

    def __init__(self, run_dir: Path) -> None:
        self._run_dir = run_dir
        self.waiting: list[tuple[Cut, float]] = []
        """Cuts that nobody was told of yet, each with its end, s."""
        self.failed: list[str] = []
        """One sentence for each cut that was over before anybody could be told."""

    def add(self, due: Cut, now: float) -> None:
        """Begin a cut with the next `do`; `now` in s."""
        self.waiting.append((due, now + due.seconds))

    def do(self, now: float) -> None:
        """Cut what waits."""
        waiting, self.waiting = self.waiting, []
        for due, end in waiting:
            try:
                cut(self._run_dir, due.a, due.b, max(0.0, end - now))
            except LocalError as error:
                if now < end:
                    self.waiting.append((due, end))
                else:
                    self.failed.append(f"{due}: {error}")
