"""What some tests need of the machine; CI has it all."""

import contextlib
import os
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from bench.rigs.fake_robots import SSHD

needs_ssh = pytest.mark.skipif(
    not os.environ.get("CI") and (SSHD is None or shutil.which("ssh") is None),
    reason="needs an ssh server and client: sudo apt-get install openssh-server openssh-client",
)


@contextmanager
def small_disk(place: Path, size: int) -> Iterator[Path]:
    """Mount a disk of `size` bytes at `place`; skips the test where this user may mount nothing."""
    place.mkdir(parents=True)
    command = ["mount", "-t", "tmpfs", "-o", f"size={size}", "small", str(place)]
    if os.geteuid() != 0 or subprocess.run(command, capture_output=True).returncode != 0:
        pytest.skip("mounting a small disk needs root and the right to mount")
    try:
        yield place
    finally:
        subprocess.run(["umount", "--lazy", str(place)], check=True)


def fill(path: Path) -> None:
    """Make a file that leaves no byte free on its disk."""
    with path.open("wb", buffering=0) as file, contextlib.suppress(OSError):
        while file.write(bytes(65536)):
            pass
    assert os.statvfs(path).f_bavail == 0
