"""Frames of the mesh, as two neighbours exchange them over an ordered byte stream (docs/reference/network/frames.md).

    length u16 | kind and class u8 | body | (tag, 8 bytes, on authenticated links after CONFIRM)

All numbers are little endian; `length` counts the bytes that follow it. The decoder checks it before anything
else, so a peer can never make us buffer more than one frame. Whatever is wrong raises `FrameError`: a stream
that was wrong once cannot be resynchronised, so the connection ends.
"""

import hmac
import struct
from collections.abc import Callable, Iterator
from typing import NamedTuple

from swarm.errors import FrameError, LocalError
from swarm.frozen import frozen
from swarm.messages.keys import MAX_KEY_LENGTH, is_name

VERSION = 3
"""The protocol version spoken here. HELLO carries a range; the two ends use the highest that both speak."""

MAGIC = b"BSWM"

HELLO, CONFIRM, BYE, HEARTBEAT, BIND, DATA, FRAGMENT, ACK, CLOCK = 1, 2, 3, 4, 5, 6, 7, 8, 9
"""Kinds of frames. The bodies of the last three are made in `fragments`, `flow` and `clock`."""

CONTROL, SYNC, BULK = 0, 1, 2
"""Priority classes, most urgent first."""

HALTS = 3
"""The class of stops in a robot's own queues, where they leave before all others. On the wire they are control."""

PRIORITIES = {"control": CONTROL, "sync": SYNC, "bulk": BULK}
"""Their names in configuration and messages."""

MAX_FRAME = 4096
"""Largest `length`. A frame in flight cannot be overtaken: at Bluetooth's 78 kB/s this one delays an urgent
one 52 ms."""

MAX_HANDSHAKE = 256
"""Largest `length` until both ends have confirmed each other."""

TAG_SIZE = 8
"""Bytes at the end of every frame for the tag of authenticated links; insecure ones leave them out."""

MAC_SIZE = 32
"""Bytes that CONFIRM carries on authenticated links."""

MAX_PAYLOAD = MAX_FRAME - 3 - TAG_SIZE
"""Largest payload of one DATA frame, in bytes."""

MAX_MESSAGE = 1024 * 1024
"""Largest message, in bytes, of the class bulk; files go by other ways."""

MAX_CHANNELS = 1024
"""Channel handles of one direction of one connection: 0 to 1023."""

NONCE_SIZE = 16
MAX_KEY_IDS = 4
MAX_NETWORK = 32
"""Longest network name, in bytes."""

_LENGTH = struct.Struct("<H")
_HEAD = struct.Struct("<HB")
_DATA_HEAD = struct.Struct("<HBH")
_HELLO = struct.Struct(f"<4sBBBBQ{NONCE_SIZE}s")
_HEARTBEAT = struct.Struct("<QQQ")
_BIND = struct.Struct("<HB")

_KINDS = frozenset((HELLO, CONFIRM, BYE, HEARTBEAT, BIND, DATA, FRAGMENT, ACK, CLOCK))
_INSECURE, _DIALLER = 1, 2

NEIGHBOURS, FLOOD, UNICAST = 0, 1, 2
"""The overlay a channel belongs to: one hop, the whole swarm, one robot anywhere (docs/explanation/overlays.md)."""

(
    CLOSING,
    BAD_FRAME,
    BAD_VERSION,
    BAD_NETWORK,
    BAD_ROBOT,
    NOT_NEIGHBOUR,
    BAD_SECURITY,
    BAD_ROLE,
    REPLACED,
    SILENT,
    BAD_KEY,
    BAD_TAG,
    UNWANTED,
    FULL,
    HELD,
    CLASH,
) = range(1, 17)
"""Why one end says BYE."""

BYE_TEXT = {
    CLOSING: "stopping",
    BAD_FRAME: "a bad frame",
    BAD_VERSION: "no common protocol version",
    BAD_NETWORK: "another network",
    BAD_ROBOT: "not the expected robot",
    NOT_NEIGHBOUR: "not a neighbour in the topology",
    BAD_SECURITY: "only one end is insecure",
    BAD_ROLE: "the dial rule",
    REPLACED: "a newer connection",
    SILENT: "silence",
    BAD_KEY: "another key",
    BAD_TAG: "a wrong tag",
    UNWANTED: "not a link of the topology, or not any more",
    FULL: "it has as many links as a robot may have",
    HELD: "held down on command",
    CLASH: "another robot with this name is in the swarm: is an SD card a copy?",
}


class VersionError(FrameError):
    """The other end speaks no version of the protocol that we speak."""


class TagError(FrameError):
    """A frame that its sender's key did not tag, or not at this place of the stream."""


Tag = Callable[[bytes], bytes]
"""Gives the tag of the next frame of one direction, from its length up to its body's end."""


class Frame(NamedTuple):
    """One frame taken off the stream; `body` is not checked yet."""

    kind: int
    priority: int
    body: bytes


@frozen
class Hello:
    """The first frame of each direction."""

    network: str
    robot: str
    incarnation: int
    """u64, drawn anew at each start of the sending process."""
    nonce: bytes
    dialler: bool
    """Whether the sender dialled this connection."""
    insecure: bool
    key_ids: tuple[int, ...] = ()
    """Which keys the sender can authenticate with; none when insecure."""
    versions: tuple[int, int] = (VERSION, VERSION)
    """Lowest and highest protocol version spoken."""


class Heartbeat(NamedTuple):
    """Three stamps of monotonic clocks, in microseconds: round trip and clock offset follow from them."""

    echo: int
    """t1: `sent` of the newest heartbeat that came from the other end; 0 = none yet."""
    received: int
    """t2: when that one arrived here."""
    sent: int
    """t3: when this one leaves."""


class Bind(NamedTuple):
    """A frame that makes this handle stand for this key in this direction of this connection."""

    channel: int
    overlay: int
    key: str


class FrameDecoder:
    """Takes a byte stream apart into frames, however it was cut. Holds at most one incomplete frame."""

    def __init__(self, limit: int = MAX_HANDSHAKE) -> None:
        self.limit = limit
        """Largest `length` accepted; the session raises it when the handshake is over."""
        self.tag: Tag | None = None
        """What the tags of the frames to come must be; None while they carry none."""
        self._rest = b""
        """The frame that is not whole yet."""

    def frames(self, data: bytes) -> Iterator[Frame]:
        """Add bytes from the stream; gives the frames that are whole now. Raises `FrameError`."""
        buffer = self._rest + data if self._rest else data
        at = 0
        while len(buffer) - at >= 2:
            length = buffer[at] | buffer[at + 1] << 8
            # Looked at anew for each frame: the one before may have ended the handshake.
            if not 1 <= length <= self.limit:
                raise FrameError(f"frame length {length}: 1 to {self.limit} are allowed")
            end = at + 2 + length
            if len(buffer) < end:
                break
            body_end = end if self.tag is None else _check_tag(self.tag, buffer, at, end)
            first = buffer[at + 2]
            kind, priority = first & 0x0F, first >> 4
            if kind not in _KINDS:
                raise FrameError(f"frame kind {kind}: not known to protocol version {VERSION}")
            if priority > BULK:
                raise FrameError(f"frame class {priority}: 0 to {BULK} are allowed")
            yield Frame(kind, priority, buffer[at + 3 : body_end])
            at = end
        self._rest = buffer[at:]


def _check_tag(tag: Tag, buffer: bytes, at: int, end: int) -> int:
    """Check the tag of a frame, and return where its body ends. Nothing of a frame counts before its tag was right."""
    start = end - TAG_SIZE
    if start < at + _HEAD.size:
        raise TagError(f"frame length {end - at - 2}: no room for a tag")
    if not hmac.compare_digest(tag(buffer[at:start]), buffer[start:end]):
        raise TagError("the tag of a frame is wrong")
    return start


def encode(kind: int, priority: int, body: bytes) -> bytes:
    """Encode a frame."""
    length = len(body) + 1
    if length > MAX_FRAME - TAG_SIZE:
        raise LocalError(f"frame of {length} bytes: at most {MAX_FRAME - TAG_SIZE} fit")
    return _HEAD.pack(length, kind | priority << 4) + body


def seal(frame: bytes, tag: Tag) -> bytes:
    """Return a frame as it goes over an authenticated link: with its tag, which `length` counts."""
    frame = _LENGTH.pack(len(frame) - _LENGTH.size + TAG_SIZE) + frame[_LENGTH.size :]
    return frame + tag(frame)


def encode_data(priority: int, channel: int, payload: bytes) -> bytes:
    """Encode a DATA frame: five bytes before the payload, which is at most `MAX_PAYLOAD` long."""
    return _DATA_HEAD.pack(len(payload) + 3, DATA | priority << 4, channel) + payload


def decode_data(body: bytes) -> tuple[int, bytes]:
    """Channel handle and payload of a DATA frame."""
    if len(body) < 2:
        raise FrameError(f"DATA of {len(body)} bytes: no channel")
    return body[0] | body[1] << 8, body[2:]


def encode_bind(bind: Bind) -> bytes:
    """Encode a BIND frame."""
    return encode(BIND, CONTROL, _BIND.pack(bind.channel, bind.overlay) + bind.key.encode())


def decode_bind(body: bytes) -> Bind:
    """Decode the body of a BIND frame. The key's characters are checked by whoever knows what may come in."""
    if not _BIND.size < len(body) <= _BIND.size + MAX_KEY_LENGTH:
        raise FrameError(f"BIND of {len(body)} bytes: a key has 1 to {MAX_KEY_LENGTH}")
    channel, overlay = _BIND.unpack_from(body)
    if channel >= MAX_CHANNELS:
        raise FrameError(f"BIND of channel {channel}: there are {MAX_CHANNELS}")
    if overlay > UNICAST:
        raise FrameError(f"BIND to overlay {overlay}: not known to protocol version {VERSION}")
    return Bind(channel, overlay, _text(body[_BIND.size :], "BIND key"))


def encode_heartbeat(stamps: Heartbeat) -> bytes:
    """Encode a HEARTBEAT frame."""
    return encode(HEARTBEAT, CONTROL, _HEARTBEAT.pack(*stamps))


def decode_heartbeat(body: bytes) -> Heartbeat:
    """Decode the body of a HEARTBEAT frame."""
    if len(body) != _HEARTBEAT.size:
        raise FrameError(f"HEARTBEAT of {len(body)} bytes: it has {_HEARTBEAT.size}")
    return Heartbeat(*_HEARTBEAT.unpack(body))


def encode_confirm(mac: bytes = b"") -> bytes:
    """Encode a CONFIRM frame: "I accept your HELLO"; on authenticated links with `MAC_SIZE` bytes that prove it."""
    return encode(CONFIRM, CONTROL, mac)


def decode_confirm(body: bytes, size: int = 0) -> bytes:
    """Return the MAC of a CONFIRM frame, `size` bytes: 0 on an insecure link."""
    if len(body) != size:
        raise FrameError(f"CONFIRM of {len(body)} bytes: it has {size} here")
    return body


def encode_bye(code: int) -> bytes:
    """Encode a BYE frame: the last one of its direction."""
    return encode(BYE, CONTROL, bytes((code,)))


def decode_bye(body: bytes) -> int:
    """Return the code of a BYE frame; codes of later versions are let through."""
    if len(body) != 1:
        raise FrameError(f"BYE of {len(body)} bytes: it has 1")
    return body[0]


def encode_hello(hello: Hello) -> bytes:
    """Encode a HELLO frame. Raises `LocalError` where a name would not fit."""
    network, robot = hello.network.encode(), hello.robot.encode()
    if not 1 <= len(network) <= MAX_NETWORK:
        raise LocalError(f"network name {hello.network!r}: 1 to {MAX_NETWORK} bytes are allowed")
    fixed = _HELLO.pack(
        MAGIC,
        *hello.versions,
        hello.insecure * _INSECURE | hello.dialler * _DIALLER,
        len(hello.key_ids),
        hello.incarnation,
        hello.nonce,
    )
    keys = struct.pack(f"<{len(hello.key_ids)}I", *hello.key_ids)
    names = bytes((len(network),)) + network + bytes((len(robot),)) + robot
    return encode(HELLO, CONTROL, fixed + keys + names)


def decode_hello(body: bytes) -> Hello:
    """Decode the body of a HELLO frame.

    Magic and version range come first and keep their place in every version, so that `VersionError` can be
    told from noise whatever follows them.
    """
    if body[:4] != MAGIC or len(body) < 6:
        raise FrameError(f"HELLO begins with {body[:6]!r}: not one of ours")
    low, high = body[4], body[5]
    if not low <= VERSION <= high:
        raise VersionError(f"the other end speaks protocol versions {low} to {high}, we speak {VERSION}")
    if len(body) < _HELLO.size:
        raise FrameError(f"HELLO of {len(body)} bytes: it has at least {_HELLO.size}")
    _, _, _, flags, count, incarnation, nonce = _HELLO.unpack_from(body)
    if flags & ~(_INSECURE | _DIALLER):
        raise FrameError(f"HELLO flags {flags:#x}: bits 0 and 1 are known")
    if count > (0 if flags & _INSECURE else MAX_KEY_IDS):
        raise FrameError(f"HELLO with {count} key ids: at most {MAX_KEY_IDS}, none when insecure")
    at = _HELLO.size + 4 * count
    if len(body) < at:
        raise FrameError(f"HELLO of {len(body)} bytes ends within its key ids")
    key_ids = struct.unpack_from(f"<{count}I", body, _HELLO.size)
    network, at = _short_text(body, at, "HELLO network")
    robot, at = _short_text(body, at, "HELLO robot")
    if not is_name(robot):
        raise FrameError(f"HELLO robot {robot!r}: not a robot's name")
    if at != len(body):
        raise FrameError(f"HELLO of {len(body)} bytes: {len(body) - at} too many")
    return Hello(
        network,
        robot,
        incarnation,
        nonce,
        bool(flags & _DIALLER),
        bool(flags & _INSECURE),
        key_ids,
        (low, high),
    )


def largest(priority: int, room: int) -> int:
    """Return the bytes that a payload of a class may have: of bulk those of all fragments, else those of a packet with
    this room."""
    return MAX_MESSAGE if priority == BULK else room


def _short_text(body: bytes, at: int, what: str) -> tuple[str, int]:
    """Return a text that follows its u8 length, and where it ends."""
    end = at + 1 + body[at] if at < len(body) else len(body) + 1
    if end > len(body) or not 1 <= end - at - 1 <= MAX_NETWORK:
        raise FrameError(f"{what}: 1 to {MAX_NETWORK} bytes are allowed and must be there")
    return _text(body[at + 1 : end], what), end


def _text(data: bytes, what: str) -> str:
    try:
        return data.decode()
    except UnicodeDecodeError:
        raise FrameError(f"{what}: not UTF-8") from None
