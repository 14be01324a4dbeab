"""Inside a machine: services whose modules are imported once for all of them, since importing is most of what starting
a dozen of them on one processor takes; and their supervisor, as systemd is on a robot.

Reads lines of JSON {"environment", "module", "words"} from its standard input; for each it forks the service and prints
its process id. One that is killed is started again and its new process id stands in RUNTIME/MODULE.pid. At the end of
the input all are told to end; the exit code says whether all ended well. They are its children and end with it.
"""

import ctypes
import faulthandler
import json
import os
import runpy
import select
import signal
import sys
import threading
import time
from pathlib import Path
from typing import Any

import services.apps.__main__
import services.mesh.__main__  # noqa: F401  imported for those to come
from swarm.files import atomic_write
from swarm.process.paths import VOLATILE

RESTART_S = 0.2
"""As the units of robots have it (RestartSec=)."""

Order = dict[str, Any]


class Supervisor:
    """The children, by process id."""

    def __init__(self) -> None:
        self._running: dict[int, Order] = {}
        self._codes: dict[int, int] = {}
        self.ending = False

    def start(self, order: Order) -> int | None:
        """The process id of the child; None in the child itself."""
        child = os.fork()
        if child:
            self._running[child] = order
            path = Path(order["environment"]["SWARM_RUNTIME"], f"{order['module']}.pid")
            atomic_write(path, str(child).encode(), unsynced=VOLATILE)
        return child or None

    def reap(self) -> list[Order]:
        """What has ended by a signal and is to be started again."""
        again = []
        while self._running:
            child, status = os.waitpid(-1, os.WNOHANG)
            if not child:
                break
            order = self._running.pop(child)
            if os.WIFSIGNALED(status) and not self.ending:
                again.append(order)
            else:
                self._codes[child] = status
        return again

    def end(self) -> bool:
        """Have all end; whether they ended well."""
        self.ending = True
        for child in self._running:
            os.kill(child, signal.SIGTERM)
        while self._running:
            self.reap()
            time.sleep(0.02)
        return not any(self._codes.values())


def serve(order: Order) -> None:
    """In the child: be that service."""
    ctypes.CDLL(None).prctl(1, signal.SIGKILL)  # PR_SET_PDEATHSIG
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    signal.set_wakeup_fd(-1)
    os.environ.update(order["environment"])
    log = os.open(Path(os.environ["SWARM_RUNTIME"]) / "log", os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    os.dup2(log, 2)  # a pipe that nobody reads would fill
    # A service that is asked writes to its log where its threads are. Python gives the signal back to who had it before
    # when it ends, and an ending process must not be killed by it.
    signal.signal(signal.SIGUSR1, signal.SIG_IGN)
    faulthandler.register(signal.SIGUSR1)
    nothing = os.open(os.devnull, os.O_RDWR)
    os.dup2(nothing, 0)
    os.dup2(nothing, 1)
    sys.argv = [order["module"], *order["words"]]
    sys.modules.pop(f"{order['module']}.__main__")
    runpy.run_module(order["module"], run_name="__main__")


def main() -> int:
    """Until standard input ends."""
    # Whole processes are copied, and of threads only this one would be.
    assert threading.active_count() == 1
    assert len(list(Path("/proc/self/task").iterdir())) == 1
    supervisor = Supervisor()
    woken, wake = os.pipe()
    os.set_blocking(wake, False)
    os.set_blocking(woken, False)
    signal.signal(signal.SIGCHLD, lambda *_: None)
    signal.set_wakeup_fd(wake)
    rest = b""
    while True:
        ready, _, _ = select.select([0, woken], [], [])
        orders: list[Order] = []
        if woken in ready:
            os.read(woken, 4096)
            orders = supervisor.reap()
            if orders:
                time.sleep(RESTART_S)
        fresh = len(orders)
        if 0 in ready:
            data = os.read(0, 65536)
            if not data:
                return 0 if supervisor.end() else 1
            *lines, rest = (rest + data).split(b"\n")
            orders += [json.loads(line) for line in lines]
        for number, order in enumerate(orders):
            child = supervisor.start(order)
            if child is None:
                serve(order)
                return 0
            if number >= fresh:
                sys.stdout.write(f"{child}\n")
                sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main())
