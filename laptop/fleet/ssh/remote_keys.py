"""A command on one robot that a person types to: keys go there over ssh as they are pressed, lines come back.

The far command has no terminal: its input is the keys' bytes and ends with the connection.
"""

import subprocess
import sys
import threading
from collections.abc import Callable

from laptop.fleet.ssh.ssh import CLIENT_FAILED, NO_SSH, NOT_INSTALLED, Host, Ssh, copy_text
from swarm.errors import LocalError
from swarm.onboard.body.keyboard import Keyboard

_NOT_FOUND = 127
"""Exit code of a shell, of sudo and of env for a program that is not there."""


def run(ssh: Ssh, host: Host, command: str, on_line: Callable[[str], None]) -> int:
    """Run the command until it ends and return its exit code; each line that it writes goes to `on_line`.

    The terminal is as before afterwards. Raises `LocalError` where the robot is out of reach or the connection breaks.
    """
    try:
        process = subprocess.Popen(
            ssh.arguments(host, command), stdin=None, stdout=subprocess.PIPE, stderr=subprocess.PIPE
        )
    except FileNotFoundError:
        raise LocalError(NO_SSH) from None
    assert process.stdout is not None
    assert process.stderr is not None
    errors = threading.Thread(target=copy_text, args=(process.stderr, sys.stderr), daemon=True)
    errors.start()
    spoke = False
    try:
        with Keyboard(sys.stdin).raw():
            for line in process.stdout:
                spoke = True
                on_line(line.decode(errors="replace").rstrip("\n"))
            code = process.wait()
    finally:
        process.kill()  # this may have been interrupted: the far command ends with its input
        process.wait()
        process.stdout.close()
        errors.join()
        process.stderr.close()
    if code == _NOT_FOUND:
        raise LocalError(f"{host.robot}: {NOT_INSTALLED}")
    if code == CLIENT_FAILED:
        problem = "the connection is lost; the robot stops by itself" if spoke else "ssh does not get through to it"
        raise LocalError(f"{host.robot}: {problem}")
    return code
