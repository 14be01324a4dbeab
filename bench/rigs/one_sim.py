"""One robot of `swarm sim` with all its processes; the others are one process that plays them (`bench.rigs.peers`).

Nobody watches it, and nobody tells its bus where it really is: on a robot there is neither.

`python -m bench.rigs.one_sim ARGUMENTS`, as of `swarm sim`, links as in `bench.rigs.socket_sim`. It runs until it is
ended.
"""

import math
from collections.abc import Sequence
from pathlib import Path

from bench.rigs import socket_sim
from laptop.cli.runs import sim
from sim.processes import monitor, run
from sim.processes.monitor import Monitor
from sim.processes.run import ProcessRun
from swarm.messages import LedChange, Target, Truth
from swarm.process import service

ROBOT = "r2"
"""The one that is there; on a line it has two neighbours."""

PEERS = "peers"


class Away(Monitor):
    """Hears and says nothing on the robots' buses."""

    def __init__(self, run_dir: Path, names: Sequence[str], app: str | None) -> None:
        super().__init__(run_dir, (), app)

    def truth(self, robot: str, message: Truth | Target | LedChange) -> None:
        """Keep it."""


class OneRobot(ProcessRun):
    """Starts the processes of one robot, and in place of the first of the others the one that plays them all."""

    def _start_robot(self, name: str) -> None:
        if name == ROBOT:
            super()._start_robot(name)
        elif self._processes.find(self._scenario.config.names[0], PEERS) is None:
            self._processes.add(name, PEERS, ["bench.rigs.peers"], self._run_dir / name)


def main() -> int:
    """Like `bench.rigs.socket_sim`. For the simulation the swarm never starts, since most robots have no bus."""
    sim.ProcessRun = OneRobot  # type: ignore[attr-defined]
    run.Monitor = Away  # type: ignore[attr-defined]
    monitor.START_LIMIT_S = math.inf
    return socket_sim.main()


if __name__ == "__main__":
    service.run(main)
