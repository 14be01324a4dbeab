"""The start and end of every process of ours, whether or not it uses the bus: this module does not load Zenoh.

The balancer's loop is such a process; `swarm.process.service` builds on it for all others.
"""

import ctypes
import logging
import os
import signal
import socket
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import NoReturn

from swarm.errors import LocalError, SwarmError
from swarm.process.end import leave
from swarm.process.terminal import guard
from swarm.process.text import printable

_PR_SET_PDEATHSIG = 1  # linux/prctl.h

DEFECT = 70
"""Exit code of a process that an unexpected error has ended (EX_SOFTWARE in sysexits.h). systemd starts it anew."""

_ends_on_defects = threading.Event()
_is_up = threading.Event()
"""Set once this process has said that it does its work."""


_SHOWN = 200
"""Characters of an error that its line in the log shows; its traceback shows all."""

_ENVIRONMENT = (
    "A service takes no arguments. The variables SWARM_CONFIG, SWARM_ROBOT and SWARM_RUNTIME name the configuration "
    "file, this robot, and the directory of the robot's sockets."
)

_log = logging.getLogger("service")


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
    if "READY=1" in message:
        _is_up.set()
    address = os.environ.get("NOTIFY_SOCKET")
    if not address:
        return
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sock:
        sock.settimeout(timeout_s)
        try:
            sock.sendto(message.encode(), "\0" + address[1:] if address.startswith("@") else address)
        except OSError as error:
            _log.warning("systemd was not notified: %s", error)


def end_on_defects(ends: bool) -> None:
    """Choose what `defect` does from now on: end this process, or only log."""
    (_ends_on_defects.set if ends else _ends_on_defects.clear)()


def defect(error: BaseException, where: str) -> None:
    """Log an error that nobody expected and, in a process under `run`, end the process with the code `DEFECT`.

    A thread that dies of such an error leaves a process that answers nobody, and a core in which it was raised may be
    half changed. A new process begins with a whole one. `where` names the thread or the callback.
    """
    try:
        _log.critical("ended by a defect in %s: %s", where, repr(error)[:_SHOWN], exc_info=error)
    except BaseException:  # noqa: BLE001 - such as MemoryError, which has brought us here
        os.write(2, b"service: ended by a defect, and by another one while that was logged\n")
    if _ends_on_defects.is_set():
        os._exit(DEFECT)


def run(main: Callable[[], int | None], about: str | None = None) -> None:
    """Run a process' main function: our own errors become one line on stderr and exit code 2.

    Whatever else ends a thread of this process, the main one included, ends the process (see `defect`). So does one of
    our own errors in a service that was ready: no wrong configuration, after which systemd would not start it again.
    `about` is what `--help` prints of a service that takes no arguments.
    """
    guard()
    if about is not None and len(sys.argv) > 1:
        _refuse_arguments(about)
    threading.excepthook = _thread_ended
    end_on_defects(True)
    _is_up.clear()
    try:
        code = main()
    except SwarmError as error:
        if _is_up.is_set():
            _main_thread_ended(error)
        path = Path(sys.argv[0])
        program = path.parent.name if path.name == "__main__.py" else path.name
        sys.stderr.write(f"{program}: {printable(str(error), None)}\n")
        code = 2
    except KeyboardInterrupt:
        code = 128 + signal.SIGINT
    except Exception as error:  # noqa: BLE001 - whatever it is, it is a defect
        _main_thread_ended(error)
    leave(code or 0)


def _main_thread_ended(error: Exception) -> NoReturn:
    end_on_defects(True)  # the main thread comes back from nothing, whatever else is being stopped
    defect(error, "the main thread")
    leave(DEFECT)


def _refuse_arguments(about: str) -> NoReturn:
    """Print the help of a service without arguments where it is asked for, else what is wrong; end the process."""
    import argparse  # no service needs it otherwise

    package = Path(sys.argv[0]).parent.name
    parser = argparse.ArgumentParser(prog=f"python -m services.{package}", description=about, epilog=_ENVIRONMENT)
    parser.parse_args()
    sys.exit(0)


def _thread_ended(arguments: threading.ExceptHookArgs) -> None:
    """Python calls this where an exception ends a thread."""
    name = arguments.thread.name if arguments.thread is not None else "unknown"
    defect(arguments.exc_value or arguments.exc_type(), f"the thread {name!r}")
