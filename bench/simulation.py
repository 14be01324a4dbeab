"""Runs `swarm sim` as a user does and hands back its JSON object."""

import json
import subprocess
import sys
import tempfile
from pathlib import Path


class SimulationError(Exception):
    """The simulation ended with a non-zero code; holds the end of what it said."""


def simulate(*arguments: str, timeout_s: float = 180.0) -> dict[str, object]:
    """Run `swarm sim ARGUMENTS --json` in a directory of its own."""
    with tempfile.TemporaryDirectory(prefix="swarm-bench-") as directory:
        command = [
            sys.executable,
            "-m",
            "swarm.cli",
            "sim",
            *arguments,
            "--json",
            "--run-dir",
            str(Path(directory) / "run"),
        ]
        done = subprocess.run(command, capture_output=True, text=True, timeout=timeout_s, check=False)
    if done.returncode != 0:
        raise SimulationError(
            f"{' '.join(arguments)}: code {done.returncode}\n{done.stdout[-500:]}\n{done.stderr[-1500:]}"
        )
    result: dict[str, object] = json.loads(done.stdout.splitlines()[-1])
    return result
