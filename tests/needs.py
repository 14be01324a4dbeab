"""What some tests need of the machine; CI has it all."""

import os
import shutil

import pytest

from bench.fake_robots import SSHD

needs_ssh = pytest.mark.skipif(
    not os.environ.get("CI") and (SSHD is None or shutil.which("ssh") is None),
    reason="needs an ssh server and client: sudo apt-get install openssh-server openssh-client",
)
