"""What the bench's robot tells of its true pose, as `sim.world` hears it."""

import math
import socket
import threading
from pathlib import Path

from sim.world import SOCKET, BodyReport
from swarm.messages.codec import decode_any

FALLEN = math.radians(45.0)
"""rad of tilt."""


class World:
    """Takes poses in a thread until closed."""

    def __init__(self, run_dir: Path) -> None:
        self.tilts: list[tuple[float, float]] = []
        """Time and true tilt, rad."""
        self.falls = 0
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind(str(run_dir / SOCKET))
        self._thread = threading.Thread(target=self._listen)
        self._thread.start()

    def close(self) -> None:
        """Stop listening."""
        self._socket.shutdown(socket.SHUT_RDWR)
        self._thread.join()
        self._socket.close()

    def _listen(self) -> None:
        fallen = False
        while data := self._socket.recv(1024):
            report = decode_any((BodyReport,), data, SOCKET)
            if report is None:
                continue
            self.tilts.append((report.t, report.tilt))
            before, fallen = fallen, abs(report.tilt) > FALLEN
            self.falls += fallen and not before
