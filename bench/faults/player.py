"""Plays faults against the processes of a running simulation, and takes stops back when their time is over."""

import os
import signal
import time
from collections import deque
from collections.abc import Sequence

from bench.rigs.simulation import Simulation, SimulationError
from sim.control.link_cuts import silence
from swarm import clock
from swarm.process.simulations import pid_file

BACK_WITHIN_S = 120.0
"""All robots have gone on by then, after the last fault."""

AT_ONCE = 5
"""So many faults at most come while a robot stands still (what comes between two pauses counts as one): a busy machine
starts services more slowly than faults come, and what is always down can show nothing."""

AT_MOST = 3
AGAIN_S = 11.0
"""A service that ends five times within 10 s is given up, by the simulation as by systemd: none is killed so often."""

POLL_S = 0.02


class Player:
    """Plays faults. Methods return how many they have played: 0 where there is nothing to be spoilt at that moment."""

    def __init__(self, simulation: Simulation, names: Sequence[str], app: str) -> None:
        """`app` is the name of the simulation's app, whose recordings tell whether robots go on."""
        self._simulation, self._names, self._app = simulation, names, app
        self._ends: list[tuple[float, str, str]] = []
        """When each stop ends, with its robot and service."""
        self._kills: dict[tuple[str, str], deque[float]] = {}
        self._recent: deque[float] = deque(maxlen=AT_ONCE)
        self._newest = 0.0
        """When the newest fault since the last pause came; 0 where none did."""

    def kill(self, robot: str, service: str, name: str) -> int:
        """End a service by the signal of this name, KILL or TERM; not one that is stopped, nor one that ended often."""
        now = time.monotonic()
        kills = self._kills.setdefault((robot, service), deque())
        while kills and kills[0] < now - AGAIN_S:
            kills.popleft()
        if len(kills) >= AT_MOST or self._stopped(robot, service) or not self._signal(robot, service, name):
            return 0
        kills.append(now)
        return self._played()

    def stop(self, robot: str, service: str, seconds: float) -> int:
        """Stop a service for a while (SIGSTOP, then SIGCONT)."""
        if self._stopped(robot, service) or not self._signal(robot, service, "STOP"):
            return 0
        self._ends.append((time.monotonic() + seconds, robot, service))
        return self._played()

    def cut(self, one: str, other: str, seconds: float, *, both: bool = True) -> int:
        """Cut a link, or with `both` false only the way on which `one` hears `other`."""
        try:
            silence(self._simulation.run_dir, one, other, seconds)
            if both:
                silence(self._simulation.run_dir, other, one, seconds)
        except OSError:
            return 0  # a mesh that was killed has no ear at this moment
        return self._played()

    def forget(self, robot: str) -> None:
        """A robot has lost its power, and with it what was stopped on it."""
        self._ends = [end for end in self._ends if end[1] != robot]
        self._played()

    def pause(self, seconds: float) -> None:
        """Wait, and go on waiting while a robot stands still after many faults. Raises `SimulationError` where one does
        not go on, or the simulation has ended."""
        if self._newest:
            self._recent.append(self._newest)
            self._newest = 0.0
        due = time.monotonic() + seconds
        while (now := time.monotonic()) < due or self._stands_still():
            self._take_back(now)
            time.sleep(POLL_S if now < due else 10 * POLL_S)

    def finish(self) -> None:
        """Take back all stops now."""
        self._take_back(float("inf"))

    def _played(self) -> int:
        self._newest = clock.now()
        return 1

    def _stopped(self, robot: str, service: str) -> bool:
        return any(end[1:] == (robot, service) for end in self._ends)

    def _take_back(self, now: float) -> None:
        for end in [end for end in self._ends if end[0] <= now]:
            self._ends.remove(end)
            self._signal(end[1], end[2], "CONT")

    def _stands_still(self) -> bool:
        """Whether a robot has done nothing since the first of the newest `AT_ONCE` faults."""
        if len(self._recent) < AT_ONCE:
            return False
        still = [name for name in self._names if self._simulation.trajectory(name, self._app).newest <= self._recent[0]]
        if still and (self._simulation.process.poll() is not None or clock.now() > self._recent[-1] + BACK_WITHIN_S):
            raise SimulationError(f"{', '.join(still)} did not go on: {self._simulation.said()}")
        return bool(still)

    def _signal(self, robot: str, service: str, name: str) -> bool:
        """By its pid file, without the second that a command takes to start."""
        try:
            pid = int(pid_file(self._simulation.run_dir, robot, service).read_text())
            os.kill(pid, getattr(signal, f"SIG{name}"))
        except (OSError, ValueError):
            return False
        return True
