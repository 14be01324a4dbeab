"""Switches simulated robots off and on: what `swarm hand reboot` asks for, done from the simulation's main thread."""

import logging
import shutil
from collections import Counter
from collections.abc import Collection
from pathlib import Path

from sim.control import datagrams
from sim.control.power_switch import DISK, SOCKET, unpack
from sim.processes.processes import Processes
from swarm.errors import PayloadError

MAX_DATAGRAM = 256

KEPT = (DISK, "dwm.tty")
"""Entries that stay in a robot's directory: its disk, and the module at its serial port, which has its own battery."""
LOGS = ".log"
"""The log files that the simulation itself writes there."""

_log = logging.getLogger("sim")


class Power:
    """The switches of all robots of a run."""

    def __init__(self, run_dir: Path, names: Collection[str], processes: Processes) -> None:
        """Raises `LocalError` where it cannot listen."""
        self._run_dir, self._names, self._processes = run_dir, names, processes
        self._off: dict[str, float] = {}
        self.cycles: Counter[str] = Counter()
        """How often each robot was switched off."""
        self._socket = datagrams.receiver(run_dir, SOCKET)

    def look(self, now: float) -> None:
        """Switch off the robots for which that was asked, and boot those that have been off for long enough."""
        for datagram, _ in datagrams.received(self._socket, MAX_DATAGRAM):
            try:
                wish = unpack(datagram)
            except PayloadError as error:
                _log.warning("no reboot: %s", error)
                continue
            if wish.robot in self._names:
                self.off(wish.robot, now, wish.seconds)
        for robot in [robot for robot, until in self._off.items() if now >= until]:
            del self._off[robot]
            self._processes.start(robot)

    def off(self, robot: str, now: float, seconds: float) -> None:
        """Switch a robot off, and after so many seconds on. A robot that is off already stays off for longer."""
        if robot not in self._off:
            self.cycles[robot] += 1
            self._switch_off(robot)
        self._off[robot] = max(self._off.get(robot, 0.0), now + seconds)

    def is_off(self, robot: str) -> bool:
        """Return whether a robot is switched off."""
        return robot in self._off

    @property
    def off_now(self) -> Collection[str]:
        """The robots that are switched off."""
        return self._off.keys()

    def close(self) -> None:
        self._socket.close()

    def _switch_off(self, robot: str) -> None:
        self._processes.kill(robot)
        directory = self._run_dir / robot
        for entry in list(directory.iterdir()):
            if entry.name in KEPT or entry.suffix == LOGS:
                continue
            if entry.is_dir():
                shutil.rmtree(entry)
            else:
                entry.unlink()
        _log.info("%s rebooted", robot)
