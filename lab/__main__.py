"""`./run lab [TEST...]`: builds the lab's machine where it is not there yet, and runs the lab's tests in it.

A TEST is the name of a file of tests/lab without `test_lab_`, or a path; other words go to pytest. `./run lab short`
runs the set that CI has time for, `./run lab build` only builds.
"""

import os
import subprocess
import sys
import time
from pathlib import Path

from lab.vm.build import UnableError, image
from swarm.errors import LocalError

TESTS = Path(__file__).parents[1] / "tests/lab"
SHORT = (
    "machine",
    "faults::test_links_over_real_sockets[each fault]",
    "mesh::test_six_robots_compute_what_the_simulation_computes[line]",
    "robot",
)
"""Of each part of the lab the tests that say most in a minute."""


UNAVAILABLE = 69
"""Exit code where this host cannot run the lab (EX_UNAVAILABLE of sysexits.h)."""


def main() -> int:
    """Exit code: `UNAVAILABLE`, 1 where the machine cannot be built, else pytest's."""
    words = sys.argv[1:]
    began = time.monotonic()
    try:
        image()
    except LocalError as error:
        sys.stderr.write(f"lab: {error}\n")
        return UNAVAILABLE if isinstance(error, UnableError) else 1
    sys.stderr.write(f"lab: the machine is there ({time.monotonic() - began:.0f} s)\n")
    if words == ["build"]:
        return 0
    if words[:1] == ["short"]:
        words[:1] = SHORT
    chosen = [_path(word) for word in words]
    if not any(Path(word.split("::")[0]).exists() for word in chosen):
        chosen.append(str(TESTS))
    # A test for each two cores: most tests start three machines or six robots, and a machine with a robot's body goes
    # before all others, which would starve. Those with the longest time-outs begin first (tests/conftest.py).
    workers = max(1, (os.cpu_count() or 1) // 2)
    words = [sys.executable, "-m", "pytest", "-m", "lab", "--durations=0", "-v", "-n", str(workers)]
    # So that what a test waits for (lab.waiting) is seen at once: standard error itself is not captured.
    words += ["--capture=sys", *chosen]
    return subprocess.run(words, check=False).returncode


def _path(word: str) -> str:
    name, colons, test = word.partition("::")
    file = TESTS / f"test_lab_{name}.py"
    return f"{file}{colons}{test}" if file.exists() else word


if __name__ == "__main__":
    sys.exit(main())
