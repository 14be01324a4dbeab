"""`python -m bench.stop.body SOCKET`: a simulated robot's balancer that tells when its motors go on and off.

The very program of a simulated robot (`sim.body`). After each control step that changes the mode, or whether
the motors are driven, it sends a datagram to SOCKET: monotonic time, s; whether the motors are driven; the mode.
"""

import socket
import struct
import sys

from services.balancer.balancer import Balancer
from services.balancer.loop import main as balance
from sim.devices.wiring import simulated_bus
from swarm import clock
from swarm.process.edges import run

TRUTH = struct.Struct("<d?")
"""What stands in front of the mode's name."""


def main() -> None:
    """Wait for orders, as a real robot does, until SIGTERM."""
    truth = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    truth.connect(sys.argv[1])
    truth.setblocking(False)
    step = Balancer.step
    told: tuple[bool, str] | None = None

    def step_and_tell(self: Balancer, now: float) -> None:
        nonlocal told
        step(self, now)
        found = any(self.duty), self.mode
        if found != told:
            told = found
            truth.send(TRUTH.pack(clock.now(), found[0]) + found[1].encode())

    Balancer.step = step_and_tell  # type: ignore[method-assign]
    balance(simulated_bus, start_mode="rest")


if __name__ == "__main__":
    run(main)
