"""What every process of ours does at its edges, whether or not it speaks to the bus: this module does not load Zenoh.

The balancer's loop is such a process; `swarm.service` builds on it for all others.
"""

import ctypes
import logging
import os
import signal
import socket
import sys
from collections.abc import Callable
from pathlib import Path

from swarm.errors import LocalError, SwarmError
from swarm.terminal import guard
from swarm.text import printable

_PR_SET_PDEATHSIG = 1  # linux/prctl.h


def die_with_parent() -> None:
    """End with SIGKILL when the process named by SWARM_PARENT dies, however it dies. Does nothing without it.

    The kernel ties the signal to the parent *thread* that started us, so simulations start services from
    their main thread. The parent may be gone before the call takes effect: hence the look afterwards. A
    service that starts a process of its own sets SWARM_PARENT to its own pid for it.
    """
    parent = os.environ.get("SWARM_PARENT")
    if not parent:
        return
    if not parent.isdecimal():
        raise LocalError(f"SWARM_PARENT={parent!r}: expected the pid of the process that started this one")
    if ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL) != 0:
        raise LocalError(f"prctl(PR_SET_PDEATHSIG): {os.strerror(ctypes.get_errno())}")
    if os.getppid() != int(parent):
        os._exit(1)


def notify(message: str, *, timeout_s: float = 1.0) -> None:
    """Send a message to systemd (sd_notify(3)): one datagram to NOTIFY_SOCKET, where there is one.

    Waits `timeout_s` at most for a systemd that hangs; 0 does not wait at all.
    """
    address = os.environ.get("NOTIFY_SOCKET")
    if not address:
        return
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sock:
        sock.settimeout(timeout_s)
        try:
            sock.sendto(message.encode(), "\0" + address[1:] if address.startswith("@") else address)
        except OSError as error:
            logging.getLogger("service").warning("systemd was not notified: %s", error)


def run(main: Callable[[], int | None]) -> None:
    """Run a process' main function: our own errors become one line on stderr and exit code 2."""
    guard()
    try:
        code = main()
    except SwarmError as error:
        path = Path(sys.argv[0])
        program = path.parent.name if path.name == "__main__.py" else path.name
        sys.stderr.write(f"{program}: {printable(str(error), None)}\n")
        code = 2
    except KeyboardInterrupt:
        code = 128 + signal.SIGINT
    sys.exit(code or 0)
