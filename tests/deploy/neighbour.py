"""The other robot of the rig that boots: r1, as processes beside the container, whose runs go on when r0 reboots."""

import os
import shutil
import sys
import tempfile
from contextlib import ExitStack
from pathlib import Path

from bench.rigs.running import running

ROOT = Path(__file__).parents[2]


class Neighbour:
    """Bus, mesh and app of r1; a context."""

    def __init__(self, config: Path, records: Path, app: Path, arguments: list[str]) -> None:
        """`records` gets the recording."""
        # Short: sockets' paths have at most 107 bytes.
        self._home = Path(tempfile.mkdtemp(prefix="swarm-"))
        own = {"SWARM_CONFIG": config, "SWARM_ROBOT": "r1", "SWARM_RUNTIME": self._home, "SWARM_RECORD": records}
        environment = {**os.environ, "PYTHONPATH": str(ROOT), **{name: str(value) for name, value in own.items()}}
        self._log = (self._home / "log").open("w")
        commands = (["services.bus"], ["services.mesh"], ["services.apps", str(app), *arguments])
        self._processes = ExitStack()  # which ends the app first; it then finishes its recording
        for command in commands:
            words = [sys.executable, "-m", *command]
            self._processes.enter_context(running(words, env=environment, stdout=self._log, stderr=self._log))

    def __enter__(self) -> "Neighbour":
        return self

    def __exit__(self, *_: object) -> None:
        self._processes.close()
        self._log.close()
        shutil.rmtree(self._home)
