"""`sim:` links: a Unix stream socket whose receiving side keeps bytes as long as a radio would.

The caller first says its name (u8 length, name), as a radio's address would. Then each write carries its
length (u32) and when it was made (f64, the machine's monotonic clock), little endian. `AIR_SOCKET` in the
runtime directory takes datagrams `{"cut": peer, "seconds": s}` (msgpack): until that time, and as long as an
earlier cut holds, nothing arrives from that peer and neither can dial the other; 0 ends all cuts. Both ends must be
told. The files of cuts in the run directory tell a mesh that is started anew which cuts hold.
"""

import contextlib
import ctypes
import logging
import os
import random
import socket
import struct
import threading
from pathlib import Path
from typing import IO

from services.mesh.links.pipe import Pipe, describe
from services.mesh.links.radio_model import AirModel, DelayLine
from swarm import clock
from swarm.errors import LocalError, PayloadError
from swarm.messages.codec import unpack
from swarm.process.locks import take_lock
from swarm.process.paths import socket_path

AIR_SOCKET = "air.sock"
LOCK = "mesh.lock"
LINK_VARIABLE = "SWARM_SIM_LINK"
CUT = ".cut"
"""The end of the name of a file that tells until when a link is cut."""

DIAL_TIMEOUT = 1.0
"""s; only a stopped neighbour makes a Unix socket wait."""

SEND_BUFFER = 25_000
"""The kernel doubles it to 50 kB, which is what an RFCOMM socket holds."""

_RECORD = struct.Struct("<Id")
_MAX_RECORD = 64 * 1024
_MAX_NAME = 16
UNREACHABLE = "unreachable"
_PR_SET_TIMERSLACK = 29  # linux/prctl.h

_log = logging.getLogger("mesh.sim")


class LinkConditions:
    """The common part of all simulated links of this robot: their properties, and which of them are cut."""

    def __init__(self, me: str, directory: Path) -> None:
        self.me = me
        self.model = AirModel.parse(os.environ.get(LINK_VARIABLE, ""))
        self.quiet_until = 0.0
        """The time, s, until which nothing can arrive that is not on the air already (`SimPipe.read`)."""
        self._lock = only_mesh(directory)
        self._path = socket_path(directory, AIR_SOCKET)
        self._sock = bound(self._path, socket.SOCK_DGRAM)
        # Of a cut that is not in a file yet the socket hears, which is there already.
        self._cuts = {peer: at for ends, at in cuts_in(directory.parent).items() if me in ends for peer in ends - {me}}
        precise_timers()
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._serve, name="air", daemon=True)
        self._thread.start()

    def cut_until(self, peer: str) -> float:
        """Return when the cut to `peer` ends; in the past when there is none."""
        return self._cuts.get(peer, 0.0)

    def line(self, peer: str) -> DelayLine:
        """Return the way of bytes from `peer` to us; both names and the seed decide its randomness."""
        return DelayLine(self.model, random.Random(f"{self.model.seed}:{peer}>{self.me}"))

    def wait_for_dial(self) -> bool:
        """Wait as long as a radio needs to find the other; False when this mesh stops meanwhile."""
        return not self._closing.wait(self.model.dial)

    def is_cut(self, peer: str) -> bool:
        """Return whether nothing passes between `peer` and us now."""
        return clock.now() < self.cut_until(peer)

    def close(self) -> None:
        self._closing.set()
        with contextlib.suppress(OSError):
            self._sock.shutdown(socket.SHUT_RDWR)
        self._thread.join(1.0)
        self._sock.close()
        self._path.unlink(missing_ok=True)
        self._lock.close()

    def _serve(self) -> None:
        while True:
            data = self._sock.recv(1024)
            if self._closing.is_set():
                return
            try:
                wish = unpack(data)
                peer, seconds = str(wish["cut"]), float(wish["seconds"])
            except (PayloadError, KeyError, TypeError, ValueError) as error:
                _log.warning("no cut: expected {cut: PEER, seconds: S}, error=%s", error)
                continue
            until = clock.now() + seconds
            self._cuts[peer] = max(self.cut_until(peer), until) if seconds else until


class SimPipe(Pipe):
    """One simulated connection."""

    def __init__(self, sock: socket.socket, air: LinkConditions, peer: str | None) -> None:
        """`peer` is whom we called; None where we were called."""
        super().__init__(sock)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER)
        self._air = air
        self._peer = peer or ""
        self._line = air.line(peer) if peer else None
        self._buffer = b""
        self._ended = False

    @property
    def restless(self) -> bool:
        """Return True: time changes what the pipe wants."""
        return True

    def offer(self, data: bytes) -> None:
        """Take bytes to be written, and note when."""
        super().offer(_RECORD.pack(len(data), clock.now()) + data)

    def wants_read(self, now: float) -> bool:
        """Return False while the line is busy, since what comes next must wait in the sender's socket."""
        return not self._ended and (self._line is None or now >= self._next_read(self._line))

    def read(self, now: float) -> None:
        """Put what is there on the air.

        What is written from now on arrives after the shortest latency at the earliest, so until then no link of this
        robot is looked at: neighbours write at about the same time, and one look serves for all of them.
        """
        data = self._receive()
        if data is None:
            return
        if data and now >= self._air.quiet_until:
            self._air.quiet_until = now + self._air.model.shortest
        self._buffer += data
        try:
            if self._line is None and self._buffer:
                self._learn_caller()
            if self._line is not None:
                self._put_on_air(self._line)
        except ConnectionError as error:
            self.fault = str(error)
            self._ended, self._line = True, None
            return
        if not data:
            self._ended = True
            if self._line is not None:
                # That the other end is gone travels like everything else.
                self._line.push(b"", now)

    def take(self, now: float) -> bytes | None:
        """Return the bytes that have come through the air."""
        if self._line is None:
            return b"" if self._ended else None
        arrival = self._line.next_arrival()
        if arrival is None or max(arrival, self._air.cut_until(self._peer)) > now:
            return None
        return self._line.pop()

    def next_change(self, now: float) -> float | None:
        """Return when the next bytes arrive, or the line takes more."""
        if self._line is None:
            return None
        arrival = self._line.next_arrival()
        if arrival is not None:
            arrival = max(arrival, self._air.cut_until(self._peer))
        if self._ended or now >= (look := self._next_read(self._line)):
            return arrival
        return look if arrival is None else min(arrival, look)

    def _next_read(self, line: DelayLine) -> float:
        return max(line.free_at, self._air.quiet_until)

    def _learn_caller(self) -> None:
        size = self._buffer[0]
        if not 1 <= size <= _MAX_NAME:
            raise ConnectionError("a caller without a name")
        if len(self._buffer) > size:
            self._peer = self._buffer[1 : size + 1].decode("ascii", "replace")
            self._buffer = self._buffer[size + 1 :]
            if self._air.is_cut(self._peer):
                raise ConnectionError(UNREACHABLE)
            self._line = self._air.line(self._peer)

    def _put_on_air(self, line: DelayLine) -> None:
        buffer, at = self._buffer, 0
        while len(buffer) - at >= _RECORD.size:
            length, stamp = _RECORD.unpack_from(buffer, at)
            if not 1 <= length <= _MAX_RECORD:
                raise ConnectionError(f"a simulated write of {length} bytes")
            end = at + _RECORD.size + length
            if len(buffer) < end:
                break
            line.push(buffer[at + _RECORD.size : end], stamp)
            at = end
        self._buffer = buffer[at:]


class SimListener:
    """A listener for `sim:` neighbours of this robot. A socket file that a killed run left is replaced."""

    def __init__(self, path: Path, air: LinkConditions) -> None:
        self._air = air
        self._path = path
        self._sock = bound(path, socket.SOCK_STREAM)
        self._sock.listen(16)
        self._sock.setblocking(False)

    def fileno(self) -> int:
        return self._sock.fileno()

    def accept(self) -> Pipe:
        """Return the next caller; raises OSError where it has gone already."""
        sock, _ = self._sock.accept()
        return SimPipe(sock, self._air, None)

    def close(self) -> None:
        self._sock.close()
        self._path.unlink(missing_ok=True)


def cut_file(run_dir: Path, a: str, b: str) -> Path:
    """Return the file that tells until when the link between two robots is cut, in s of the machine's monotonic
    clock."""
    return run_dir / f"{min(a, b)}.{max(a, b)}{CUT}"


def cuts_in(run_dir: Path) -> dict[frozenset[str], float]:
    """Return until when links are cut, by their two robots, as the files of cuts in a run directory tell it."""
    found = {}
    for path in run_dir.glob(f"*{CUT}"):
        with contextlib.suppress(OSError, ValueError):  # a cut that is just being written, or mended
            a, b = path.stem.split(".")
            found[frozenset((a, b))] = float(path.read_text(encoding="ascii"))
    return found


def dial(path: Path, air: LinkConditions, peer: str) -> Pipe:
    """Connect to `peer`; raises OSError."""
    if not air.wait_for_dial() or air.is_cut(peer):
        raise ConnectionError(UNREACHABLE)
    sock = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    sock.settimeout(DIAL_TIMEOUT)
    try:
        sock.connect(os.fspath(path))
        sock.sendall(bytes((len(air.me),)) + air.me.encode())
    except OSError:
        sock.close()
        raise
    return SimPipe(sock, air, peer)


def precise_timers() -> None:
    """Have timers of this thread, and of those that it starts, end when they are due. The kernel may delay one by 50 us
    to save power; here that would be latency nobody asked for."""
    ctypes.CDLL(None).prctl(_PR_SET_TIMERSLACK, 1)


def only_mesh(directory: Path) -> IO[str]:
    """Return the lock of a robot's runtime directory, open. Who holds it owns the sockets there; the kernel lets go of
    it however the owner ends. Raises `LocalError` where another mesh has it."""
    try:
        lock = (directory / LOCK).open("w")
    except OSError as error:
        raise LocalError(f"{directory / LOCK}: {describe(error)}") from None
    try:
        take_lock(lock.fileno())
    except BlockingIOError:
        lock.close()
        raise LocalError(f"{directory}: another mesh of this robot runs already") from None
    return lock


def bound(path: Path, kind: socket.SocketKind) -> socket.socket:
    """Bind a Unix socket at `path`, in place of one that a killed run left."""
    sock = socket.socket(socket.AF_UNIX, kind)
    try:
        path.unlink(missing_ok=True)
        sock.bind(os.fspath(path))
    except OSError as error:
        sock.close()
        raise LocalError(f"{path}: {describe(error)}") from None
    return sock
