"""A command on one robot that a person types to: keys go there over ssh as they are pressed, lines come back.

The far command has no terminal: its input is the keys' bytes and ends with the connection.
"""

import subprocess
import sys
from collections.abc import Callable

from laptop.fleet.ssh.ssh import Host, Ssh
from swarm.errors import LocalError
from swarm.onboard.body.keyboard import Keyboard

_CLIENT_FAILED = 255


def run(ssh: Ssh, host: Host, command: str, on_line: Callable[[str], None]) -> int:
    """Run the command until it ends and return its exit code; each line that it writes goes to `on_line`.

    The terminal is as before afterwards. Raises `LocalError` where the robot is out of reach or the connection breaks.
    """
    try:
        process = subprocess.Popen(ssh.arguments(host, command), stdin=None, stdout=subprocess.PIPE, text=True)
    except FileNotFoundError:
        raise LocalError("there is no ssh here: sudo apt-get install openssh-client") from None
    assert process.stdout is not None
    try:
        with Keyboard(sys.stdin).raw():
            for line in process.stdout:
                on_line(line.rstrip("\n"))
            code = process.wait()
    finally:
        process.kill()  # where this was interrupted: the far command ends with its input
        process.wait()
        process.stdout.close()
    if code == _CLIENT_FAILED:
        raise LocalError(f"{host.robot}: the connection is lost, or there was none; the robot stops by itself")
    return code
