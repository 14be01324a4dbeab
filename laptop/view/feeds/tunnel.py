"""The bus of one real robot, seen through ssh: what `swarm.onboard.lookout` tells there, and the way back for commands.

The connection is made again whenever it breaks, until closed.
"""

import contextlib
import logging
import os
import subprocess
import tempfile
import threading
from collections.abc import Callable
from functools import partial
from typing import IO

import msgpack

from laptop.fleet.ssh.ssh import CLIENT_FAILED, CURRENT, NO_SSH, Host, Ssh, explain, last_words
from swarm import clock
from swarm.errors import LocalError, PayloadError
from swarm.messages import Arm
from swarm.messages.codec import MAX_PAYLOAD, encode
from swarm.onboard.lookout import MAX_COMMAND, unpacked

PROGRAM = f"sudo -n {CURRENT}/bin/python -P -m swarm.onboard.lookout"
RETRY_S = (1.0, 2.0, 5.0)
"""Seconds before the first, the second and all later tries to connect again."""

_OLD_RELEASE = "No module named swarm.onboard.lookout"
_LONGEST_ERROR = 4000
_END_S = 2.0
_GARBAGE = "it says what this program does not understand: is its release another one?"

_log = logging.getLogger("view")
_LARGEST = 4 * MAX_PAYLOAD
"""The most bytes of one message of a robot, four times the largest one that its lookout passes on."""


class Tunnel:
    """The connection to one robot."""

    def __init__(self, ssh: Ssh, host: Host, take: Callable[[list[object]], None], changed: Callable[[], None]) -> None:
        """`take` gets each array that the robot's lookout tells, in a thread of ours. `changed()` is called when
        `connected` or `problem` change."""
        self.host = host
        self.connected = False
        """Whether the robot's lookout is connected."""
        self.problem = ""
        """Why the lookout is not connected, in words; empty if it is, or if nobody has tried yet."""
        self._arguments = ssh.arguments(host, f"{PROGRAM} {host.robot}")
        self._take = take
        self._changed = changed
        self._lock = threading.Lock()
        """The lock that protects the process and its input."""
        self._process: subprocess.Popen[bytes] | None = None
        self._clock: float | None = None
        """How far the robot's clock is ahead of ours, s, by its newest message: less by what that was under way. None
        before the first one."""
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"tunnel {host.robot}", daemon=True)
        self._thread.start()

    def publish(self, key: str, message: object, *, urgent: bool = False) -> None:
        """Publish a message on the robot's bus. It is lost where the robot cannot be reached or the network is full, as
        on a bus.

        The end of a stop goes with the robot's time, by which the robot sees how long it was under way; without that it
        is lost, too.
        """
        command: list[object] = [key, message if isinstance(message, bytes) else encode(message)]
        if isinstance(message, Arm):
            if self._clock is None:
                return
            command.append(clock.now() + self._clock)
        data: bytes = msgpack.packb(command)
        if len(data) > MAX_COMMAND:
            raise LocalError(f"{key}: {len(data)} bytes, a command has at most {MAX_COMMAND}")
        with self._lock:
            if self._process is not None and self._process.stdin is not None:
                with contextlib.suppress(OSError):  # a full pipe takes all of it or nothing
                    os.write(self._process.stdin.fileno(), data)

    def close(self) -> None:
        """End the connection, by which the lookout on the robot ends, too."""
        self._closing.set()
        with self._lock:
            if self._process is not None:
                self._process.terminate()
        self._thread.join()

    def _run(self) -> None:
        tries = 0
        while not self._closing.is_set():
            try:
                heard = self._once()
            except Exception as error:  # noqa: BLE001 - whatever it is, the next try may do better
                _log.exception("the way to %s has failed", self.host.robot)
                heard = False
                self._tell(False, f"the way there has failed: {error}")
            tries = 0 if heard else tries + 1
            self._closing.wait(RETRY_S[min(tries, len(RETRY_S) - 1)])

    def _once(self) -> bool:
        """Run one connection to its end; return whether the robot has said anything."""
        # Errors go to a file, since nobody has to read it meanwhile, and a connection that ssh shares may keep it open.
        with tempfile.TemporaryFile() as errors:
            try:
                # The process has a session of its own: Ctrl-C ends us, and we end the process.
                process = subprocess.Popen(
                    self._arguments,
                    stdin=subprocess.PIPE,
                    stdout=subprocess.PIPE,
                    stderr=errors,
                    bufsize=0,
                    start_new_session=True,
                )
            except FileNotFoundError:
                self._tell(False, NO_SSH)
                return False
            assert process.stdin is not None
            assert process.stdout is not None
            os.set_blocking(process.stdin.fileno(), False)
            self._clock = None
            with self._lock:
                self._process = process
                if self._closing.is_set():
                    process.terminate()
            heard, problem = False, ""
            try:
                heard, problem = self._read(process.stdout)
                if problem:
                    process.terminate()
            finally:
                code = _end(process)
                with self._lock:
                    self._process = None
                    process.stdin.close()
                    process.stdout.close()
            errors.seek(max(0, errors.tell() - _LONGEST_ERROR))
            problem = problem or self._explain(code, errors.read().decode(errors="replace"))
        if not self._closing.is_set():
            self._tell(False, problem)
        return heard

    def _read(self, stream: IO[bytes]) -> tuple[bool, str]:
        """Take what the robot says until the stream ends. Return whether there was anything, and what was wrong with
        it."""
        heard = False
        try:
            for said in unpacked(iter(partial(stream.read, 1 << 16), b""), _LARGEST):
                if not isinstance(said, list) or not said:
                    return heard, _GARBAGE
                if not heard:
                    heard = True
                    self._tell(True, "")
                if said[0] == "clock" and isinstance(said[-1], float):
                    self._clock = said[-1] - clock.now()
                    continue
                try:
                    self._take(said)
                except Exception:  # noqa: BLE001 - a defect here; the way to this robot may be needed for a stop
                    _log.exception("a message that came through %s could not be taken", self.host.robot)
        except PayloadError:
            return heard, _GARBAGE
        return heard, ""

    def _tell(self, connected: bool, problem: str) -> None:
        if (connected, problem) != (self.connected, self.problem):
            self.connected, self.problem = connected, problem
            self._changed()

    def _explain(self, code: int, err: str) -> str:
        if code == CLIENT_FAILED:
            return explain(self.host, err)
        if _OLD_RELEASE in err:
            return "its release is older than this program: swarm deploy"
        return last_words(err) or f"its lookout has ended (exit code {code})"


def _end(process: subprocess.Popen[bytes]) -> int:
    """Return the exit code of a connection that has ended, or was told to."""
    try:
        return process.wait(_END_S)
    except subprocess.TimeoutExpired:
        process.kill()
        return process.wait()
