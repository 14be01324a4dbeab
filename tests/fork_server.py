"""Our programs' processes, forked from one Python that has imported all of them: importing is most of what starting one
takes, and tests start hundreds.

`start` is `subprocess.Popen`, and what it starts is a child of this process as any other, with its own environment,
folder and streams. Simulations that it starts fork their robots' services, too; others (a few in
tests/sim/test_end_to_end.py and elsewhere) start the same services by `python -m`.
"""

import atexit
import ctypes
import gc
import importlib
import json
import os
import runpy
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

PACKAGES = (
    "services.apps",
    "services.balancer",
    "services.bus",
    "services.dwm",
    "services.dwm.calibrate",
    "services.mesh",
)
MODULES = (
    "bench.talking_sim",
    "laptop.cli.runs.sim",
    "laptop.cli.z_sub",
    "services.balancer.bridge",
    "services.dwm.tool",
    "sim.body",
)
SIMULATIONS = ("laptop.cli.runs.sim", "bench.talking_sim")
"""They start services themselves."""
COMMAND = "laptop.cli"
"""Its `__main__` is one line, and does something when imported."""

_PR_SET_CHILD_SUBREAPER = 36  # linux/prctl.h
_ROOM = 1 << 17
"""Bytes of one order: words and an environment."""

_control: socket.socket | None = None
_one = threading.Lock()
"""One order at a time: the answers say not to which order."""


def start(command: Sequence[str], env: Mapping[str, str] = os.environ, **streams: Any) -> "subprocess.Popen[Any]":
    """Start `python WORDS`, the quicker way where that is the same."""
    python, *words = command
    plain = python == sys.executable and words[0] == "-m" and words[1] in (*PACKAGES, *MODULES, COMMAND)
    # Another path may bring another `sitecustomize`.
    same = plain and env.get("PYTHONPATH") == os.environ.get("PYTHONPATH") and "PYTHONHASHSEED" not in env
    return (_Forked if same else subprocess.Popen)(list(command), env=dict(env), **streams)


class _Forked(subprocess.Popen[Any]):
    """A process that the fork server has forked."""

    def _execute_child(self, args: Any, *rest: Any) -> None:
        """In place of fork and exec."""
        environment, pipes = rest[5], rest[9:15]  # both ends of each, as its caller has them
        streams = [number if given < 0 else given for number, given in enumerate((pipes[0], pipes[3], pipes[5]))]
        order = json.dumps([args[2:], str(Path.cwd()), environment]).encode()
        with _one:
            control = _fork_server()
            # Whoever is between the fork server and the program ends at once, and its orphan is to be ours.
            ctypes.CDLL(None).prctl(_PR_SET_CHILD_SUBREAPER, 1)
            socket.send_fds(control, [order], streams)
            self.pid = int(control.recv(_ROOM))
            ctypes.CDLL(None).prctl(_PR_SET_CHILD_SUBREAPER, 0)
        if (group := rest[-1]) >= 0:
            os.setpgid(self.pid, group)
        self._child_created = True
        self._close_pipe_fds(*pipes)  # type: ignore[attr-defined]


def _fork_server() -> socket.socket:
    """Return the socket of this process's fork server, which ends when nobody holds the socket any more."""
    global _control
    if _control is None:
        _control, inside = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        process = subprocess.Popen([sys.executable, __file__], stdin=inside, stdout=subprocess.DEVNULL)
        inside.close()
        atexit.register(_end, _control, process.wait)
    return _control


def _end(control: socket.socket, wait: Callable[[], object]) -> None:
    """End the fork server behind the socket."""
    control.close()
    wait()


def _prepare() -> dict[str, str]:
    """Import all that can be asked for; what that has added to the environment."""
    before = set(os.environ)
    programs = [*(f"{each}.__main__" for each in PACKAGES), *MODULES]
    for each in (*programs, COMMAND):
        importlib.import_module(each)
    for each in programs:
        del sys.modules[each]  # it is run under another name
    gc.freeze()
    return {name: value for name, value in os.environ.items() if name not in before}


def _serve(control: socket.socket, chosen: dict[str, str]) -> list[str]:
    """Fork a process for each order; returns the words of its order in each of them."""
    # Of threads only the one that forks would be copied.
    assert threading.active_count() == 1
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    while True:
        order, streams, _, _ = socket.recv_fds(control, _ROOM, 3)
        if not order:
            os._exit(0)
        waits, begin = os.pipe()
        if not os.fork():
            if os.fork():
                os._exit(0)
            os.close(begin)
            os.read(waits, 1)  # until the one between is gone, and this is the child of who asked for it
            os.close(waits)
            break
        os.wait()
        for number in (waits, begin, *streams):
            os.close(number)
    control.send(str(os.getpid()).encode())
    control.close()
    signal.signal(signal.SIGINT, signal.default_int_handler)
    for number, stream in enumerate(streams):
        os.dup2(stream, number)
        os.close(stream)
    words, folder, environment = json.loads(order)
    os.chdir(folder)
    sys.path[0] = folder
    os.environ.clear()
    os.environ.update(chosen | environment)
    return words


def _become_fork_server(words: list[str], chosen: dict[str, str]) -> list[str]:
    """Give this simulation, which has not begun, a fork server: a copy of it; returns the words of the order in
    the simulation and in each process that its fork server forks."""
    global _control
    from sim import processes

    _control, inside = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    fork_server = os.fork()
    if not fork_server:
        _control.close()
        return _serve(inside, chosen)
    inside.close()
    atexit.register(_end, _control, partial(os.waitpid, fork_server, 0))
    processes.subprocess = SimpleNamespace(**{**vars(subprocess), "Popen": start})  # type: ignore[assignment]
    return words


if __name__ == "__main__":
    _chosen = _prepare()
    sys.argv = _serve(socket.socket(fileno=os.dup(0)), _chosen)
    if sys.argv[0] in SIMULATIONS:
        sys.argv = _become_fork_server(sys.argv, _chosen)
    runpy.run_module(sys.argv[0], run_name="__main__", alter_sys=True)
