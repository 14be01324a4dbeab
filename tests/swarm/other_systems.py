"""What a system other than Linux lacks, taken away before anything of the project is imported: a test's own program.

python other_systems.py SYSTEM COMMAND...     the command line of a laptop; SYSTEM: windows or macos
python other_systems.py SYSTEM                a run from Python
"""

import asyncio
import os
import signal
import socket
import sys
import time
from importlib.abc import MetaPathFinder

NEITHER = {
    signal: "sigtimedwait pidfd_send_signal",
    socket: "AF_BLUETOOTH AF_NETLINK SOCK_CLOEXEC SOCK_NONBLOCK",
    os: (
        "eventfd eventfd_read eventfd_write EFD_NONBLOCK EFD_CLOEXEC sched_setscheduler SCHED_FIFO sched_getaffinity "
        "pidfd_open posix_fallocate fdatasync pipe2 memfd_create"
    ),
    time: "CLOCK_BOOTTIME",
}
"""What Python has on Linux alone, by its modules."""
NOT_ON_WINDOWS = {
    signal: "SIGALRM SIGHUP SIGPIPE SIGUSR1 SIGUSR2 SIGQUIT pthread_sigmask pthread_kill setitimer",
    socket: "AF_UNIX",
    os: (
        "forkpty geteuid getuid getgid getegid mkfifo O_CLOEXEC O_DIRECTORY O_NONBLOCK O_NOFOLLOW fchmod killpg setsid "
        "getpgid statvfs nice fchown chown pread pwrite"
    ),
}
MODULES = {"fcntl", "tty", "termios", "resource", "pwd", "grp", "pty", "syslog", "readline", "curses"}
"""Modules that Windows lacks."""


class Missing(MetaPathFinder):
    """Finds no module of these."""

    def find_spec(self, name, path, target=None):
        if name in MODULES:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)


def loopback_pair(*_):
    """A pair of connected sockets as Windows has them, where asyncio takes them from."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        near = socket.create_connection(server.getsockname())
        far, _ = server.accept()
    return near, far


def no_handler(*_):
    """Windows' event loop takes no handlers of signals."""
    raise NotImplementedError


WINDOWS = sys.argv[1] == "windows"

for lacking in (NEITHER, NOT_ON_WINDOWS) if WINDOWS else (NEITHER,):
    for place, names in lacking.items():
        for each in names.split():
            if hasattr(place, each):
                delattr(place, each)
if WINDOWS:
    sys.meta_path.insert(0, Missing())
    for module in MODULES:
        sys.modules.pop(module, None)
    socket.socketpair = loopback_pair
    asyncio.SelectorEventLoop.add_signal_handler = no_handler

if __name__ == "__main__" and sys.argv[2:]:
    from laptop.cli import main

    main(sys.argv[2:])
elif __name__ == "__main__":
    from swarm import SyncApp, load, simulate

    class Mean(SyncApp):
        value: float

        def step(self, neighbours):
            self.value += sum(w * (n.value - self.value) for w, n in self.weighted(neighbours))

    run = simulate(Mean, robots=6, topology="loop", values={"value": [0, 1, 2, 3, 4, 5]}, iterations=60)
    run.save("saved")
    assert abs(load("saved")["value"][-1].mean() - 2.5) < 1e-9
