"""`rfcomm:` links, over Bluetooth Classic, by the sockets of the standard library.

Once connected they are pipes like those of TCP; what is special is how they are made and what their errors mean. Who
calls is known by its Bluetooth address, so a caller must be the robot that has it. An address can be forged, of course:
the check keeps honest robots apart, the key keeps strangers out.
"""

import contextlib
import errno
import socket
import struct
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from services.mesh.core.link.calls import UNKNOWN, Caller
from services.mesh.links import stream
from services.mesh.links.page import Paging
from services.mesh.links.pipe import Pipe, describe
from swarm.errors import LocalError
from swarm.frozen import frozen

DIAL_TIMEOUT = 10.0
"""Seconds from the page on. The kernel gives up an absent robot after 5.2 s with EHOSTDOWN, which says more than a
time-out; encryption with nobody to answer for the pairing (no bluetoothd) hangs for ever."""

SOL_BLUETOOTH = 274
BT_SECURITY = 4
SECURITY_MEDIUM = 2
"""From linux/net/bluetooth/bluetooth.h; Python has no names for them. Medium = encrypted, paired without asking."""

SOL_RFCOMM = 18
RFCOMM_LM = 3
RFCOMM_LM_MASTER = 1
"""From linux/net/bluetooth/rfcomm.h: who accepts asks for a switch of roles, to be the central."""

_SECURITY = struct.Struct("BB")
"""struct bt_security: level, key size (0 = the kernel's choice)."""

ECHO_REQUEST = struct.pack("<BBH", 0x08, 200, 0)
"""L2CAP Echo Request without data (Core specification, vol 3 part A, 4.8). The kernel leaves identifiers from 200 on to
programs."""

Open = Callable[[], socket.socket]

HINTS = {
    errno.EHOSTUNREACH: (
        "the own Bluetooth adapter is not there, is switched off, or has another address than swarm.toml says "
        "(bluetoothctl list)"
    ),
    errno.EHOSTDOWN: "not in range, switched off, or deaf to robots it is not paired with (swarm pair)",
    errno.EBUSY: "an earlier connection to it has not ended yet",
    errno.ECONNREFUSED: "no mesh listens there on that channel, or it is paired with others, not with us (swarm pair)",
    errno.EACCES: "it refuses to pair for encryption",
    errno.EBADE: "it has lost the key of the pairing, or has another one (swarm pair)",
    errno.EADDRINUSE: "something else listens on that channel (bluetoothd -C holds channel 8)",
    errno.EAFNOSUPPORT: "this kernel has no Bluetooth",
    errno.EPROTONOSUPPORT: "this kernel has no RFCOMM (modprobe rfcomm)",
}
"""What an error of an RFCOMM socket means for us, as measured on Linux 6.12.

See docs/reference/network/frames.md, sockets.
"""


@frozen
class Radio:
    """This robot's side of all its RFCOMM links."""

    adapter: str
    """Address of the own adapter, as the config has it: XX:XX:XX:XX:XX:XX."""
    channel: int = 1
    """RFCOMM channel of the mesh on every robot, 1 to 30."""
    encrypt: bool = False
    """Whether the links are to be encrypted by Bluetooth itself, which needs bluetoothd on both robots."""
    calls_all: bool = False
    """Whether this robot calls all others. Who calls it knocks only, and the link that follows has its own central."""


def open_socket() -> socket.socket:
    """Open an RFCOMM socket. Raises `LocalError` where Python was built without them."""
    if not hasattr(socket, "AF_BLUETOOTH"):
        raise LocalError(
            "this Python was built without Bluetooth sockets (AF_BLUETOOTH): run the mesh with Debian's python3, "
            "for example from a venv made by: /usr/bin/python3 -m venv --system-site-packages VENV"
        )
    return socket.socket(socket.AF_BLUETOOTH, socket.SOCK_STREAM, socket.BTPROTO_RFCOMM)


def open_l2cap_socket() -> socket.socket:
    """Open a raw L2CAP socket. Raises OSError where this process may not have one."""
    return socket.socket(socket.AF_BLUETOOTH, socket.SOCK_RAW, socket.BTPROTO_L2CAP)


class RfcommPipe(Pipe):
    """A connection over an RFCOMM socket."""

    def __init__(self, sock: socket.socket, own: str, peer: str, caller: Caller = UNKNOWN) -> None:
        """`own` and `peer`: the Bluetooth addresses of both ends."""
        super().__init__(sock, caller)
        self._own, self._peer = own, peer

    def nudge(self) -> None:
        """Send an L2CAP echo request to the other end.

        All connections of an adapter share its controller's buffers. When one that was silent ends, Linux 6.12 gives
        its buffers back but sends nothing on by itself (hci_conn_del). An RFCOMM connection that has used up its
        credits writes nothing either, until its close times out after 40 s. An echo needs no credits, and has the
        kernel look at all that waits. It takes CAP_NET_RAW; without it a link may be lost in such a case, and comes
        back.
        """
        with contextlib.suppress(OSError), contextlib.closing(open_l2cap_socket()) as raw:
            raw.setblocking(False)
            raw.bind((self._own, 0))
            raw.connect((self._peer, 0))  # at once: the connection below is there
            raw.send(ECHO_REQUEST)


def dial(radio: Radio, address: str, *, paging: Paging | None = None, open_socket: Open = open_socket) -> Pipe:
    """Connect to the robot with that Bluetooth address; raises OSError whose text says what it means. `paging` is what
    all calls of the adapter share, where there may be several at a time."""
    sock = None
    try:
        sock = open_socket()
        _prepare(sock, radio)
        # Channel 0: any; only the adapter matters.
        sock.bind((radio.adapter, 0))
        (paging or Paging(radio.adapter)).connect(sock, (address, radio.channel), DIAL_TIMEOUT)
    except OSError as error:
        if sock is not None:
            sock.close()
        raise explained(error) from None
    return RfcommPipe(sock, radio.adapter, address)


class RfcommListener(stream.StreamListener):
    """A listener for `rfcomm:` neighbours of this robot."""

    def __init__(
        self,
        radio: Radio,
        robots: Mapping[str, str],
        *,
        open_socket: Open = open_socket,
        supervise: Callable[[str, str, float], None] = lambda own, peer, seconds: None,
    ) -> None:
        """`robots` has the name of the robot of each known Bluetooth address. `supervise(own, peer, seconds)` limits
        the silence of a connection, as `services.mesh.links.supervision.try_limit`."""
        self._supervise = supervise
        self._robots = {address.upper(): name for address, name in robots.items()}
        self._adapter = radio.adapter
        sock = None
        try:
            sock = open_socket()
            _prepare(sock, radio)
            if radio.calls_all:
                sock.setsockopt(SOL_RFCOMM, RFCOMM_LM, RFCOMM_LM_MASTER)
            sock.bind((radio.adapter, radio.channel))
            sock.listen(stream.BACKLOG)
        except OSError as error:
            if sock is not None:
                sock.close()
            raise LocalError(
                f"Bluetooth {radio.adapter} channel {radio.channel}: {explained(error).strerror}"
            ) from None
        super().__init__(sock)

    def set_calls_all(self, calls_all: bool) -> None:
        """Take another value of `Radio.calls_all`, for callers from now on. Any thread may call this."""
        self._sock.setsockopt(SOL_RFCOMM, RFCOMM_LM, RFCOMM_LM_MASTER if calls_all else 0)

    def _adopt(self, sock: socket.socket, address: Any) -> Pipe:
        who = str(address[0]).upper()
        pipe = RfcommPipe(sock, self._adapter, who, Caller(who, robot=self._robots.get(who, "")))
        pipe.limit = partial(self._supervise, self._adapter, who)
        return pipe


def _prepare(sock: socket.socket, radio: Radio) -> None:
    """Settings that must be there before connect or listen."""
    if radio.encrypt:
        sock.setsockopt(SOL_BLUETOOTH, BT_SECURITY, _SECURITY.pack(SECURITY_MEDIUM, 0))


def explained(error: OSError) -> OSError:
    """Return the error with a text that says what it means here. A time-out of Python's own has no number."""
    text = describe(error)
    if error.errno is None and isinstance(error, TimeoutError):
        return OSError(errno.ETIMEDOUT, f"no answer within {DIAL_TIMEOUT:g} s")
    hint = HINTS.get(error.errno or 0)
    return OSError(error.errno or 0, f"{text}: {hint}" if hint else text)
