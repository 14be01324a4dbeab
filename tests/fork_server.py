"""Our programs' processes, forked from one Python that has imported all of them: importing is most of what starting one
takes, and tests start hundreds.

`start` is as `subprocess.Popen`, and what it starts is a child of this process as any other, with its own environment,
folder and streams. Simulations that it starts fork their robots' services, too; others (a few in
tests/sim/test_end_to_end.py and elsewhere) start the same services by `python -m`.
"""

import atexit
import contextlib
import ctypes
import gc
import importlib
import json
import os
import runpy
import select
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

PACKAGES = (
    "services.apps",
    "services.balancer",
    "services.bus",
    "services.dwm",
    "services.dwm.calibrate",
    "services.mesh",
)
MODULES = (
    "bench.rigs.talking_sim",
    "laptop.cli.runs.sim",
    "laptop.cli.z_sub",
    "services.balancer.bridge.bridge",
    "sim.body",
)
SIMULATIONS = ("laptop.cli.runs.sim", "bench.rigs.talking_sim")
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
    """Start `python [-P] -m MODULE WORDS`, the quicker way where that is the same."""
    python, *words = command
    words = words[1:] if words[0] == "-P" else words
    plain = python == sys.executable and words[0] == "-m" and words[1] in (*PACKAGES, *MODULES, COMMAND)
    # Another path may bring another `sitecustomize`.
    same = plain and env.get("PYTHONPATH") == os.environ.get("PYTHONPATH") and "PYTHONHASHSEED" not in env
    if not same:
        return subprocess.Popen(list(command), env=dict(env), **streams)
    return cast("subprocess.Popen[Any]", Forked(words[1:], dict(env), **streams))


class Forked:
    """A process that the fork server has forked, with those parts of `subprocess.Popen` that tests use."""

    def __init__(
        self, words: list[str], env: dict[str, str], *, stdin: Any = None, stdout: Any = None, stderr: Any = None,
        text: bool = False, process_group: int | None = None,
    ) -> None:  # fmt: skip
        """`words`: the module and its arguments. Each stream is None, a file, PIPE or DEVNULL of `subprocess`."""
        self.args = words
        self.returncode: int | None = None
        with contextlib.ExitStack() as theirs:
            self.stdin, given = _stream(stdin, 0, text, theirs)
            self.stdout, out = _stream(stdout, 1, text, theirs)
            self.stderr, err = _stream(stderr, 2, text, theirs)
            self.pid = _order(words, env, [given, out, err])
        self._end = os.pidfd_open(self.pid)
        if process_group is not None:
            os.setpgid(self.pid, process_group)

    def poll(self) -> int | None:
        """The exit code, negative for a signal; None while it runs."""
        if self.returncode is None:
            pid, status = os.waitpid(self.pid, os.WNOHANG)
            if pid:
                self.returncode = os.waitstatus_to_exitcode(status)
                os.close(self._end)
        return self.returncode

    def wait(self, timeout: float | None = None) -> int:
        """Wait for its end; `subprocess.TimeoutExpired` where it does not come in time."""
        if self.poll() is None and not select.select([self._end], [], [], timeout)[0]:
            raise subprocess.TimeoutExpired(self.args, timeout or 0.0)
        code = self.poll()
        assert code is not None
        return code

    def send_signal(self, number: int) -> None:
        """Send a signal where it still runs."""
        if self.poll() is None:
            os.kill(self.pid, number)

    def terminate(self) -> None:
        """Send SIGTERM."""
        self.send_signal(signal.SIGTERM)

    def kill(self) -> None:
        """Send SIGKILL."""
        self.send_signal(signal.SIGKILL)

    def communicate(self, given: Any = None, timeout: float | None = None) -> tuple[Any, Any]:
        """Write what is given, read both streams to their ends, and wait."""
        said: dict[str, Any] = {}

        def read(name: str, stream: Any) -> None:
            said[name] = stream.read()
            stream.close()

        names = [name for name in ("stdout", "stderr") if getattr(self, name) and not getattr(self, name).closed]
        readers = [threading.Thread(target=read, args=(name, getattr(self, name)), daemon=True) for name in names]
        for reader in readers:
            reader.start()
        if self.stdin and not self.stdin.closed:
            with contextlib.suppress(BrokenPipeError):
                if given:
                    self.stdin.write(given)
                self.stdin.close()
        end = None if timeout is None else time.monotonic() + timeout
        for reader in readers:
            reader.join(None if end is None else max(0.0, end - time.monotonic()))
            if reader.is_alive():
                raise subprocess.TimeoutExpired(self.args, timeout or 0.0)
        self.wait(None if end is None else max(0.1, end - time.monotonic()))
        return said.get("stdout"), said.get("stderr")

    def __enter__(self) -> "Forked":
        return self

    def __exit__(self, *_: object) -> None:
        for stream in (self.stdin, self.stdout, self.stderr):
            if stream:
                stream.close()
        self.wait()


def _stream(wanted: Any, number: int, text: bool, theirs: contextlib.ExitStack) -> tuple[Any, int]:
    """Our end of a stream, None where it is no pipe, and the descriptor that the process gets."""
    if wanted is None:
        return None, number
    if wanted == subprocess.DEVNULL:
        descriptor = os.open(os.devnull, os.O_RDWR)
        theirs.callback(os.close, descriptor)
        return None, descriptor
    if wanted != subprocess.PIPE:
        return None, wanted if isinstance(wanted, int) else wanted.fileno()
    ours, its = os.pipe()[:: 1 if number else -1]
    theirs.callback(os.close, its)
    return os.fdopen(ours, ("r" if number else "w") + ("" if text else "b")), its


def _order(words: list[str], env: dict[str, str], streams: list[int]) -> int:
    """Have the fork server fork a process with these streams; returns its pid. It is a child of this process."""
    order = json.dumps([words, str(Path.cwd()), env]).encode()
    with _one:
        control = _fork_server()
        # Whoever is between the fork server and the program ends at once, and its orphan is to be ours.
        ctypes.CDLL(None).prctl(_PR_SET_CHILD_SUBREAPER, 1)
        socket.send_fds(control, [order], streams)
        pid = int(control.recv(_ROOM))
        ctypes.CDLL(None).prctl(_PR_SET_CHILD_SUBREAPER, 0)
    return pid


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
    from sim.processes import processes

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
