"""The loop's hold on its bridge process: started, talked to without ever waiting, replaced when it ends or hangs."""

import contextlib
import fcntl
import logging
import os
import select
import signal
import socket
import sys
import termios

from services.balancer.bridge.link import COMMANDS_A_TICK, MAX_DATAGRAM, LoopMessage, pack, unpack, unpack_command
from services.balancer.core.faults import STOPPED
from swarm.errors import LocalError, PayloadError
from swarm.messages import Stop

MODULE = "services.balancer.bridge.bridge"
RESTART_S = 1.0
"""Least time between two starts."""
HANG_S = 3.0
"""A bridge that has taken no message for longer hangs, and hears no stop: it is ended. It shows by `ROOM` when nothing
more fits."""
START_S = 30.0
"""Instead of `HANG_S` for a bridge that has not yet read anything: a Pi that boots takes its time to load Zenoh."""
ROOM = 65536
"""SO_SNDBUF of the telemetry's socket, bytes. The kernel doubles it; 128 messages fit, of 2.5 s."""
_GRACE_S = 2.0
_STOPS_AT_ONCE = 64
"""Stops that are taken from the socket in a tick; all but the first are not looked at."""
_NOT_FOR_THE_BRIDGE = ("NOTIFY_SOCKET", "WATCHDOG_PID", "WATCHDOG_USEC")
"""systemd hears of the loop, not of the bridge."""

OOM_SCORE_ADJUST = "300"
"""The setting of the bridge, as of an app: where memory runs out it is ended, not the loop, which its unit protects."""

_log = logging.getLogger("balancer")


class Bridge:
    """One running bridge process, or the wait for the next."""

    def __init__(self, now: float, *, stopped: bool = False) -> None:
        """Start the process; `stopped` as in `keep_up`."""
        self.pid = 0
        """The process id; 0 where there is none."""
        self._socket: socket.socket | None = None
        self._stops: socket.socket | None = None
        self._stop_is_there = select.poll()
        """Asked in each tick: that costs a third of a look into an empty socket."""
        self._last_stop: Stop | None = None
        """A stop of a process that has ended, which the loop has not taken yet."""
        self._started = now
        self._took = False
        """Whether a message has fitted since it was last looked at."""
        self._took_at = now
        self._reads = False
        """Whether it has read all messages at one time, so that it has started."""
        self.dropped = 0
        """Messages that did not fit or found no bridge."""
        self._start(now, stopped=stopped)

    def send(self, message: LoopMessage) -> bool:
        """Hand over a message, or drop it; True when it was taken."""
        if self._socket is not None:
            # Full, or the bridge is gone; which one shows in keep_up. Or it is too large: no message ends the loop.
            with contextlib.suppress(OSError, LocalError):
                self._socket.send(pack(message))
                self._took = True
                return True
        self.dropped += 1
        return False

    def stop(self) -> Stop | None:
        """Return the first stop that the bridge sent since the last call; None where it sent none."""
        if self._last_stop is not None:
            last, self._last_stop = self._last_stop, None
            return last
        if self._stops is None or not self._stop_is_there.poll(0):
            return None
        first = self._receive(self._stops)
        if first is None:  # the bridge is gone
            return None
        for _ in range(_STOPS_AT_ONCE - 1):
            if self._receive(self._stops) is None:
                break
        with contextlib.suppress(PayloadError):
            if isinstance(message := unpack(first), Stop):
                return message
        return Stop(0.0, "", "")

    def commands(self) -> list[tuple[float, LoopMessage]]:
        """Return the commands that the bridge sent since the last call, a few at most, and when it had heard each,
        s."""
        received: list[tuple[float, LoopMessage]] = []
        while len(received) < COMMANDS_A_TICK and (datagram := self._receive(self._socket)) is not None:
            try:
                received.append(unpack_command(datagram))
            except PayloadError as error:
                _log.warning("the bridge sent what is no message: %s", error)
        return received

    def keep_up(self, now: float, *, stopped: bool = False) -> None:
        """Look whether the process lives and takes messages, and start the next one in time; once a second is often
        enough. `stopped`: whether a stop is the last that the loop has obeyed, which the next process then knows."""
        if self.pid:
            pid, status = os.waitpid(self.pid, os.WNOHANG)
            if pid == 0:
                self._end_if_it_hangs(now)
                return
            _log.warning("the bridge ended code=%d", os.waitstatus_to_exitcode(status))
            self._last_stop = self.stop()
            self._forget()
        if now - self._started >= RESTART_S:
            try:
                self._start(now, stopped=stopped)
            except OSError as error:  # no memory, process or descriptor is left
                _log.error("the bridge cannot be started, and is tried again: %s", error.strerror)
                self._forget()

    def _end_if_it_hangs(self, now: float) -> None:
        if self._took:
            self._took, self._took_at = False, now
            self._reads = self._reads or self._has_read_all()
            return
        patience = HANG_S if self._reads else START_S
        if now - self._took_at > patience:
            _log.error("the bridge has taken no message for %g s and is killed", patience)
            os.kill(self.pid, signal.SIGKILL)

    def _has_read_all(self) -> bool:
        assert self._socket is not None
        return not any(fcntl.ioctl(self._socket, termios.TIOCOUTQ, bytes(4)))

    def close(self) -> None:
        """End the process and wait for it."""
        if not self.pid:
            return
        descriptor = os.pidfd_open(self.pid)
        try:
            os.kill(self.pid, signal.SIGTERM)
            if not select.select([descriptor], [], [], _GRACE_S)[0]:
                _log.warning("the bridge did not stop within %g s and was killed", _GRACE_S)
                os.kill(self.pid, signal.SIGKILL)
            os.waitpid(self.pid, 0)
        finally:
            os.close(descriptor)
            self._forget()

    @staticmethod
    def _receive(end: socket.socket | None) -> bytes | None:
        """Return the next datagram; None where there is none, or no bridge."""
        if end is None:
            return None
        try:
            return end.recv(MAX_DATAGRAM) or None
        except OSError:
            return None

    def _forget(self) -> None:
        self.pid = 0
        for end in (self._socket, self._stops):
            if end is not None:
                end.close()
        self._socket = self._stops = None

    def _start(self, now: float, *, stopped: bool = False) -> None:
        """Fork and exec: a fork of this one-threaded process returns at once, while posix_spawn and subprocess hold the
        parent until the child, which has no real-time priority, was given a CPU and reached its exec."""
        self._started = self._took_at = now
        self._took = self._reads = False
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        ours.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, ROOM)
        self._socket = ours
        our_stops, their_stops = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._stops = our_stops
        ours.setblocking(False)
        our_stops.setblocking(False)
        environment = {name: value for name, value in os.environ.items() if name not in _NOT_FOR_THE_BRIDGE}
        environment["SWARM_PARENT"] = str(os.getpid())
        command = [sys.executable, "-P", "-m", MODULE, str(theirs.fileno()), str(their_stops.fileno())]
        command += [STOPPED] if stopped else []
        try:
            pid = os.fork()
        except OSError:
            theirs.close()
            their_stops.close()
            raise
        if pid == 0:
            try:
                theirs.set_inheritable(True)
                their_stops.set_inheritable(True)
                with contextlib.suppress(OSError), open("/proc/self/oom_score_adj", "w") as score:  # noqa: PTH123
                    score.write(OOM_SCORE_ADJUST)
                os.execve(sys.executable, command, environment)  # noqa: S606
            finally:
                os._exit(127)
        theirs.close()
        their_stops.close()
        self.pid = pid
        self._stop_is_there = select.poll()
        self._stop_is_there.register(our_stops, select.POLLIN)
