"""`sim:` links: a Unix stream socket whose receiving side keeps bytes as long as a radio would.

The caller first says its name (u8 length, name), as a radio's address would. Then each write carries its
length (u32) and when it was made (f64, the machine's monotonic clock), little endian. `AIR_SOCKET` in the
runtime directory takes datagrams `{"cut": peer, "seconds": s}` (msgpack): until that time nothing arrives
from that peer and neither can dial the other. Both ends must be told.
"""

import contextlib
import ctypes
import fcntl
import logging
import os
import random
import select
import socket
import struct
import threading
from pathlib import Path

from services.mesh.core.delay import AirModel, DelayLine
from services.mesh.links.pipe import READ_SIZE, Pipe, describe
from swarm import clock
from swarm.codec import unpack
from swarm.errors import LocalError, PayloadError
from swarm.paths import socket_path

AIR_SOCKET = "air.sock"
LOCK = "mesh.lock"
LINK_VARIABLE = "SWARM_SIM_LINK"

DIAL_TIMEOUT = 1.0
"""s; only a stopped neighbour makes a Unix socket wait."""

SEND_BUFFER = 25_000
"""The kernel doubles it to 50 kB, which is what an RFCOMM socket holds."""

_RECORD = struct.Struct("<Id")
_MAX_RECORD = 64 * 1024
_MAX_NAME = 16
_PR_SET_TIMERSLACK = 29  # linux/prctl.h

_log = logging.getLogger("mesh.sim")


class Air:
    """What all simulated links of this robot share: how they are, and which of them are cut."""

    def __init__(self, me: str, directory: Path) -> None:
        self.me = me
        self.model = AirModel.parse(os.environ.get(LINK_VARIABLE, ""))
        self._cuts: dict[str, float] = {}
        # Who holds the lock owns the sockets here; the kernel lets go of it however the owner ends.
        try:
            self._lock = (directory / LOCK).open("w")
        except OSError as error:
            raise LocalError(f"{directory / LOCK}: {describe(error)}") from None
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            self._lock.close()
            raise LocalError(f"{directory}: another mesh of this robot runs already") from None
        self._path = socket_path(directory, AIR_SOCKET)
        self._sock = _bound(self._path, socket.SOCK_DGRAM)
        self._closing = False
        self._thread = threading.Thread(target=self._serve, name="air", daemon=True)
        self._thread.start()

    def cut_until(self, peer: str) -> float:
        """When the cut to `peer` ends; in the past when there is none."""
        return self._cuts.get(peer, 0.0)

    def is_cut(self, peer: str) -> bool:
        """Whether nothing passes between `peer` and us now."""
        return clock.now() < self.cut_until(peer)

    def close(self) -> None:
        """Stop taking cuts."""
        self._closing = True
        with contextlib.suppress(OSError):
            self._sock.shutdown(socket.SHUT_RDWR)
        self._thread.join(1.0)
        self._sock.close()
        self._path.unlink(missing_ok=True)
        self._lock.close()

    def _serve(self) -> None:
        while True:
            data = self._sock.recv(1024)
            if self._closing:
                return
            try:
                wish = unpack(data)
                peer, seconds = str(wish["cut"]), float(wish["seconds"])
            except (PayloadError, KeyError, TypeError, ValueError) as error:
                _log.warning("no cut: expected {cut: PEER, seconds: S}, error=%s", error)
                continue
            self._cuts[peer] = clock.now() + seconds


class SimPipe(Pipe):
    """One simulated connection."""

    def __init__(self, sock: socket.socket, air: Air, peer: str | None) -> None:
        """`peer` is whom we called; None where we were called."""
        super().__init__(sock)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER)
        self._air = air
        self._peer = peer
        self._line: DelayLine | None = None
        self._buffer = b""
        self._ended = False
        self._woken = threading.Event()

    def offer(self, data: bytes) -> None:
        """Take bytes to be written, and note when."""
        super().offer(_RECORD.pack(len(data), clock.now()) + data)

    def shutdown(self) -> None:
        """End the connection and wake the reader, even from what is still on the air."""
        super().shutdown()
        self._woken.set()

    def read(self) -> bytes:
        """Wait until the next bytes have come through the air."""
        line = self._line or self._begin()
        assert self._peer is not None
        while not self._shut:
            arrival, now = line.next_arrival(), clock.now()
            if arrival is not None:
                arrival = max(arrival, self._air.cut_until(self._peer))
                if arrival <= now:
                    return line.pop()
            if self._ended or now < line.free_at:
                # Nothing may be read now. An Event wakes as precisely as select does.
                ends = [end for end in (arrival, None if self._ended else line.free_at) if end is not None]
                self._woken.wait(min(ends) - now)
            elif arrival is None or select.select([self._sock], [], [], arrival - now)[0]:
                self._take(line, self._sock.recv(READ_SIZE))
        return b""

    def _take(self, line: DelayLine, data: bytes) -> None:
        if not data:
            # That the peer is gone travels like everything else.
            self._ended = True
            line.push(b"", clock.now())
            return
        buffer, at = self._buffer + data, 0
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

    def _begin(self) -> DelayLine:
        """The reader's first call: learn who calls, and make the line whose randomness both names decide."""
        # The kernel may delay a timer by 50 us to save power; here that would be latency nobody asked for.
        ctypes.CDLL(None).prctl(_PR_SET_TIMERSLACK, 1)
        if self._peer is None:
            self._peer = self._read_name()
        if self._air.is_cut(self._peer):
            raise ConnectionError("unreachable")
        model, me = self._air.model, self._air.me
        self._line = DelayLine(model, random.Random(f"{model.seed}:{self._peer}>{me}").gauss)
        return self._line

    def _read_name(self) -> str:
        size = self._sock.recv(1)
        name = self._sock.recv(size[0]) if size and size[0] <= _MAX_NAME else b""
        if not name:
            raise ConnectionError("a caller without a name")
        return name.decode("ascii", "replace")


class Listener:
    """Where `sim:` neighbours reach this robot. A socket file that a killed run left is replaced."""

    def __init__(self, path: Path, air: Air) -> None:
        self._air = air
        self._path = path
        self._sock = _bound(path, socket.SOCK_STREAM)
        self._sock.listen(16)
        self._sock.setblocking(False)

    def fileno(self) -> int:
        """For select."""
        return self._sock.fileno()

    def accept(self) -> Pipe:
        """The next caller; raises OSError where it has gone already."""
        sock, _ = self._sock.accept()
        sock.setblocking(True)
        return SimPipe(sock, self._air, None)

    def close(self) -> None:
        """Stop listening."""
        self._sock.close()
        self._path.unlink(missing_ok=True)


def dial(path: Path, air: Air, peer: str) -> Pipe:
    """Connect to `peer`; raises OSError."""
    if air.is_cut(peer):
        raise ConnectionError("unreachable")
    sock = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    sock.settimeout(DIAL_TIMEOUT)
    try:
        sock.connect(os.fspath(path))
        sock.sendall(bytes((len(air.me),)) + air.me.encode())
        sock.settimeout(None)
    except OSError:
        sock.close()
        raise
    return SimPipe(sock, air, peer)


def _bound(path: Path, kind: socket.SocketKind) -> socket.socket:
    """A Unix socket at `path`, in place of one that a killed run left."""
    sock = socket.socket(socket.AF_UNIX, kind)
    try:
        path.unlink(missing_ok=True)
        sock.bind(os.fspath(path))
    except OSError as error:
        sock.close()
        raise LocalError(f"{path}: {describe(error)}") from None
    return sock
