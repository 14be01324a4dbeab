"""What a system other than Linux lacks, taken away before anything of the project is imported: a test's own program.

python other_systems.py COMMAND...     the command line of a laptop
python other_systems.py                a run from Python
"""

import asyncio
import os
import signal
import socket
import sys
from importlib.abc import MetaPathFinder

MODULES = {"fcntl", "tty", "termios", "resource", "pwd", "grp", "pty", "syslog", "readline", "curses"}
NAMES = {
    signal: "SIGALRM SIGHUP SIGPIPE SIGUSR1 SIGUSR2 SIGQUIT pthread_sigmask pthread_kill setitimer sigtimedwait",
    socket: "AF_UNIX AF_BLUETOOTH AF_NETLINK",
    os: (
        "forkpty geteuid getuid getgid getegid eventfd EFD_NONBLOCK EFD_CLOEXEC sched_setscheduler SCHED_FIFO mkfifo "
        "O_CLOEXEC O_DIRECTORY O_NONBLOCK O_NOFOLLOW pidfd_open posix_fallocate fchmod killpg setsid getpgid statvfs "
        "fdatasync nice fchown chown pread pwrite"
    ),
}


class Missing(MetaPathFinder):
    """Finds no module of these."""

    def find_spec(self, name, path, target=None):
        if name in MODULES:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)


sys.meta_path.insert(0, Missing())
for module in MODULES:
    sys.modules.pop(module, None)
for place, names in NAMES.items():
    for each in names.split():
        if hasattr(place, each):
            delattr(place, each)


def loopback_pair(*_):
    """A pair of connected sockets as Windows has them, where asyncio takes them from."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        near = socket.create_connection(server.getsockname())
        far, _ = server.accept()
    return near, far


def no_handler(*_):
    """Windows' event loop takes no handlers of signals."""
    raise NotImplementedError


socket.socketpair = loopback_pair
asyncio.SelectorEventLoop.add_signal_handler = no_handler

if __name__ == "__main__" and sys.argv[1:]:
    from laptop.cli import main

    main(sys.argv[1:])
elif __name__ == "__main__":
    from swarm import SyncApp, load, simulate

    class Mean(SyncApp):
        value: float

        def step(self, neighbours):
            self.value += sum(w * (n.value - self.value) for w, n in self.weighted(neighbours))

    run = simulate(Mean, robots=6, topology="loop", values={"value": [0, 1, 2, 3, 4, 5]}, iterations=60)
    run.save("saved")
    assert abs(load("saved")["value"][-1].mean() - 2.5) < 1e-9
