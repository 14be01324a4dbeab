"""The other robot of the rig that boots: r1, as processes beside the container, whose runs go on when r0 reboots."""

import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

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
        self._processes = [
            subprocess.Popen([sys.executable, "-m", *command], env=environment, stdout=self._log, stderr=self._log)
            for command in commands
        ]

    def __enter__(self) -> "Neighbour":
        return self

    def __exit__(self, *_: object) -> None:
        for process in reversed(self._processes):  # the app first, which finishes its recording
            process.terminate()
            process.wait(60)
        self._log.close()
        shutil.rmtree(self._home)
