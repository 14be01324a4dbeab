"""Several keys' messages in one message of the bus: what came together wakes its receiver once.

Each part is the key's length (u8), the payload's (u32, little endian), key and payload.
"""

import struct
from collections.abc import Iterable, Iterator

from swarm.errors import PayloadError

_HEAD = struct.Struct("<BI")


def pack(parts: Iterable[tuple[str, bytes]]) -> bytes:
    """One message of `(key, payload)` pairs; keys have at most 255 letters."""
    chunks: list[bytes] = []
    for key, payload in parts:
        name = key.encode()
        chunks += (_HEAD.pack(len(name), len(payload)), name, payload)
    return b"".join(chunks)


def unpack(data: bytes) -> Iterator[tuple[str, bytes]]:
    """The pairs, in order. Raises `PayloadError` where the message is none."""
    at = 0
    while at < len(data):
        if len(data) - at < _HEAD.size:
            raise PayloadError(f"{len(data) - at} bytes behind the last part")
        size, length = _HEAD.unpack_from(data, at)
        middle = at + _HEAD.size + size
        end = middle + length
        if end > len(data):
            raise PayloadError(f"a part of {size + length} bytes where {len(data) - at - _HEAD.size} are left")
        try:
            key = data[at + _HEAD.size : middle].decode("ascii")
        except UnicodeDecodeError:
            raise PayloadError("a part whose key is not ASCII") from None
        yield key, data[middle:end]
        at = end
