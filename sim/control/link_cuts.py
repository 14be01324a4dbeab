"""Cuts of the simulated radio. The radio process is told of a cut. Where there is none, a datagram tells the `sim:`
transport of the mesh at each end of the link. A file in the run directory tells meshes that start later."""

import contextlib
import socket
from pathlib import Path

import msgpack

from services.mesh.links import slots
from services.mesh.links.sim import AIR_SOCKET, cut_file, cuts_in
from swarm import clock
from swarm.errors import LocalError


def cut_link(run_dir: Path, robot: str, peer: str, seconds: float) -> None:
    """Cut the radio between two robots of a simulation for some seconds, or as long as an earlier cut lasts; 0 ends all
    cuts of the link. Raises `LocalError`."""
    if robot == peer:
        raise LocalError(f"not cut: {robot} has no link with itself")
    for name in (robot, peer):
        if not (run_dir / name).is_dir():
            raise LocalError(f"not cut: there is no robot {name} in {run_dir}")
    file, now = cut_file(run_dir, robot, peer), clock.now()
    try:
        if seconds:
            until = max(now + seconds, cuts_in(run_dir).get(frozenset((robot, peer)), 0.0))
            file.write_text(f"{until!r}\n", encoding="ascii")
            seconds = until - now
        else:
            file.unlink(missing_ok=True)
    except OSError as error:
        raise LocalError(f"not cut: {file}: {error.strerror}") from None
    # Only now, since what is not running yet reads the file when it listens.
    radio = run_dir / slots.RADIO_SOCKET
    if radio.exists():
        with contextlib.suppress(OSError):
            slots.ask(radio, slots.RadioCut(robot, peer, float(seconds))).close()
        return
    for end, other in ((robot, peer), (peer, robot)):
        with contextlib.suppress(OSError):
            silence(run_dir, end, other, seconds)


def silence(run_dir: Path, robot: str, peer: str, seconds: float) -> None:
    """Let nothing pass between `robot` and `peer` at the robot's end. A link is cut when both ends are told.

    Raises OSError where the robot's mesh is not there.
    """
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sock:
        sock.sendto(msgpack.packb({"cut": peer, "seconds": seconds}), str(run_dir / robot / AIR_SOCKET))
