"""The loop's hold on its bridge process: started, talked to without ever waiting, started again when it ends."""

import contextlib
import logging
import os
import select
import signal
import socket
import sys

from services.balancer.link import MAX_DATAGRAM, Message, pack, unpack
from swarm.errors import PayloadError

MODULE = "services.balancer.bridge"
RESTART_S = 1.0
"""Least time between two starts."""
_GRACE_S = 2.0
_COMMANDS_AT_ONCE = 8
"""A flood of commands may not eat up the slack of a tick."""
_NOT_FOR_THE_BRIDGE = ("NOTIFY_SOCKET", "WATCHDOG_PID", "WATCHDOG_USEC")
"""systemd hears of the loop, not of the bridge."""

OOM_SCORE_ADJUST = "300"
"""Of the bridge, as of an app: where memory runs out it is ended, not the loop, which its unit protects."""

_log = logging.getLogger("balancer")


class Bridge:
    """One running bridge process, or the wait for the next."""

    def __init__(self, now: float) -> None:
        """Starts the process."""
        self._pid = 0
        self._socket: socket.socket | None = None
        self._started = now
        self.dropped = 0
        """Messages that did not fit or found no bridge."""
        self._start(now)

    def send(self, message: Message) -> bool:
        """Hand over a message, or drop it; True when it was taken."""
        if self._socket is not None:
            # Full, or the bridge is gone; which one shows in keep_up.
            with contextlib.suppress(OSError):
                self._socket.send(pack(message))
                return True
        self.dropped += 1
        return False

    def commands(self) -> list[Message]:
        """What the bridge sent since the last call, a few at most."""
        received: list[Message] = []
        while self._socket is not None and len(received) < _COMMANDS_AT_ONCE:
            try:
                datagram = self._socket.recv(MAX_DATAGRAM)
            except OSError:  # nothing there
                break
            if not datagram:  # the bridge is gone
                break
            try:
                received.append(unpack(datagram))
            except PayloadError as error:
                _log.warning("the bridge sent what is no message: %s", error)
        return received

    def keep_up(self, now: float) -> None:
        """Look whether the process lives, and start the next one in time; once a second is often enough."""
        if self._pid:
            pid, status = os.waitpid(self._pid, os.WNOHANG)
            if pid == 0:
                return
            _log.warning("the bridge ended code=%d", os.waitstatus_to_exitcode(status))
            self._forget()
        if now - self._started >= RESTART_S:
            self._start(now)

    def close(self) -> None:
        """End the process and wait for it."""
        if not self._pid:
            return
        descriptor = os.pidfd_open(self._pid)
        try:
            os.kill(self._pid, signal.SIGTERM)
            if not select.select([descriptor], [], [], _GRACE_S)[0]:
                _log.warning("the bridge did not stop within %g s and was killed", _GRACE_S)
                os.kill(self._pid, signal.SIGKILL)
            os.waitpid(self._pid, 0)
        finally:
            os.close(descriptor)
            self._forget()

    def _forget(self) -> None:
        self._pid = 0
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _start(self, now: float) -> None:
        """Fork and exec: a fork of this one-threaded process returns at once, while posix_spawn and subprocess hold the
        parent until the child, which has no real-time priority, was given a CPU and reached its exec."""
        self._started = now
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        ours.setblocking(False)
        environment = {name: value for name, value in os.environ.items() if name not in _NOT_FOR_THE_BRIDGE}
        environment["SWARM_PARENT"] = str(os.getpid())
        command = [sys.executable, "-m", MODULE, str(theirs.fileno())]
        pid = os.fork()
        if pid == 0:
            try:
                theirs.set_inheritable(True)
                with contextlib.suppress(OSError), open("/proc/self/oom_score_adj", "w") as score:  # noqa: PTH123
                    score.write(OOM_SCORE_ADJUST)
                os.execve(sys.executable, command, environment)  # noqa: S606
            finally:
                os._exit(127)
        theirs.close()
        self._pid, self._socket = pid, ours
