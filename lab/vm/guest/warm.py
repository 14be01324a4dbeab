"""Inside a lab machine: the release's Python with the services' modules and pytest imported, from which programs are
forked; importing is most of what starting one costs an emulated processor.

Their door is the program `python` beside this file: a packet with its folder, words and environment, and its three
streams. It gets the exit code; where it goes, what it has started goes, too.
"""

import gc
import io
import os
import runpy
import select
import signal
import socket
import sys
import threading
from pathlib import Path

import pytest

import services.apps.__main__
import services.mesh.__main__
import services.mesh.discover
import swarm.recording.run

IMPORTED = (pytest, services.apps.__main__, services.mesh.__main__, services.mesh.discover, swarm.recording.run)
"""For those to come."""

DOOR = Path("/run/lab-warm")
ROOM = 262144


def program(folder: str, words: list[str], environment: dict[str, str]) -> None:
    """In a child: be Python, started with these words."""
    os.chdir(folder)
    os.environ.clear()
    os.environ.update(environment)
    sys.stdin = io.TextIOWrapper(io.FileIO(0))
    sys.stdout, sys.stderr = (io.TextIOWrapper(io.FileIO(each, "w"), write_through=True) for each in (1, 2))
    sys.path[1:1] = filter(None, environment.get("PYTHONPATH", "").split(":"))
    first, *sys.argv = words
    if first == "-m":
        sys.path[0] = folder
        runpy.run_module(sys.argv[0], run_name="__main__", alter_sys=True)
    else:
        sys.argv.insert(0, first)
        sys.path[0] = str(Path(first).resolve().parent)
        runpy.run_path(first, run_name="__main__")


def keep(door: socket.socket) -> int | None:
    """In a child: start the program and wait for it, and end it where nobody does that any more; None in itself."""
    data, streams, _, _ = socket.recv_fds(door, ROOM, 3)
    folder, count, *rest = os.fsdecode(data).split("\0")
    words, environment = rest[: int(count)], rest[int(count) :]
    child = os.fork()
    if not child:
        door.close()
        for number, stream in enumerate(streams):
            os.dup2(stream, number)
            os.close(stream)
        program(folder, words, dict(each.split("=", 1) for each in environment))
        return None
    for stream in (0, 1, 2, *streams):
        os.close(stream)
    ended = os.pidfd_open(child)
    if ended not in select.select([ended, door.fileno()], [], [])[0]:
        os.kill(child, signal.SIGKILL)
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    door.send(bytes([code if code >= 0 else 128 - code]))
    os._exit(0)


def main() -> None:
    """Until the machine goes off."""
    # Whole processes are copied, and of threads only this one would be.
    assert threading.active_count() == 1
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    listener.bind(str(DOOR))
    listener.listen(16)
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # nobody waits for those who keep a program
    gc.freeze()
    while True:
        door, _ = listener.accept()
        if not os.fork():
            signal.signal(signal.SIGCHLD, signal.SIG_DFL)
            listener.close()
            keep(door)
            return
        door.close()


if __name__ == "__main__":
    main()
