"""Makes a recorded run without waiting for one."""

import subprocess
import sys
from pathlib import Path


def recorded(folder: Path, app: str, *arguments: str) -> None:
    """Run an app under virtual time, with its recording in `folder`."""
    command = [sys.executable, "-m", "laptop.cli", "sim", app, "--virtual", *arguments, "--record", str(folder)]
    subprocess.run(command, check=True, capture_output=True, timeout=240)
