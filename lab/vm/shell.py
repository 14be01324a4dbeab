"""Commands of the host that build something."""

import os
import subprocess

from swarm.errors import LocalError


def sh(*words: object, **more: str) -> str:
    """Run a command, with more of an environment; its output. `LocalError` with what it said where it fails."""
    done = subprocess.run(
        [str(word) for word in words], capture_output=True, text=True, env={**os.environ, **more}, check=False
    )
    if done.returncode:
        raise LocalError(f"{words[0]} failed with {done.returncode}: {(done.stdout + done.stderr)[-2000:]}")
    return done.stdout
