"""The authentication of a connection: keys agreed on in the handshake, and a tag for each frame after it.

From the pre-shared key and both HELLOs, byte by byte as they were sent, HKDF (RFC 5869, SHA-256) derives four keys
that serve this connection only: one for the CONFIRM and one for the frames of each direction. The HELLOs hold nonces,
names, incarnations, version ranges, network, flags, key ids and roles, so two ends that disagree on any of these hold
different keys. The dialler's HELLO comes first in the transcript, whoever computes it.

Frames are tagged by keyed BLAKE2b (RFC 7693), a MAC without the double hash of HMAC: 0.4 us for a short frame against
1.0 us of hmac and 0.4 us of AES-CMAC from `cryptography`, whose import alone costs 6 MB (docs/explanation/security.md).
"""

import hashlib
import hmac
import struct
from collections.abc import Collection

from services.mesh.core.wire.frames import MAC_SIZE, TAG_SIZE, seal

_KEY_SIZE = 32
_SUITE = b"balboa-swarm mesh, HKDF-SHA256 HMAC-SHA256 BLAKE2b-64"
_INFO = struct.Struct("<BI")
_COUNTER = struct.Struct("<Q")


def hkdf(secret: bytes, salt: bytes, info: bytes, length: int) -> bytes:
    """`length` bytes, at most 8160, derived from `secret` (RFC 5869, extract and expand with SHA-256)."""
    pseudo_random = hmac.digest(salt, secret, "sha256")
    block, output, count = b"", b"", 0
    while len(output) < length:
        count += 1
        block = hmac.digest(pseudo_random, block + info + bytes((count,)), "sha256")
        output += block
    return output[:length]


def newest_common(ours: Collection[int], theirs: Collection[int]) -> int | None:
    """Return the id of the key to use: the highest one both ends have, since ids grow with time; None = there is
    none."""
    return max(set(ours).intersection(theirs), default=None)


class Tagger:
    """The tags of the frames of one direction, in the order of the wire: each counts one on."""

    def __init__(self, key: bytes, count: int = 0) -> None:
        self._keyed = hashlib.blake2b(key=key, digest_size=TAG_SIZE)
        self._count = count

    def __call__(self, frame: bytes) -> bytes:
        """Return the tag of the next frame, given from its length up to its body's end."""
        mac = self._keyed.copy()
        mac.update(_COUNTER.pack(self._count) + frame)
        self._count += 1
        return mac.digest()


class Keys:
    """The keys of one connection, as one of its two ends uses them."""

    def __init__(self, secret: bytes, key_id: int, version: int, ours: bytes, theirs: bytes, *, dialler: bool) -> None:
        """`ours` and `theirs` are the HELLO frames of both ends; `dialler` says whether we dialled."""
        self._transcript = ours + theirs if dialler else theirs + ours
        salt = hashlib.sha256(self._transcript).digest()
        derived = hkdf(secret, salt, _SUITE + _INFO.pack(version, key_id), 4 * _KEY_SIZE)
        confirms = derived[:_KEY_SIZE], derived[_KEY_SIZE : 2 * _KEY_SIZE]
        tags = derived[2 * _KEY_SIZE : 3 * _KEY_SIZE], derived[3 * _KEY_SIZE :]
        we, they = (0, 1) if dialler else (1, 0)
        self._their_confirm = confirms[they]
        self.confirm = self._mac(confirms[we])
        """What our CONFIRM carries."""
        self.outbound = Tagger(tags[we])
        self.inbound = Tagger(tags[they])
        self._sealing = False

    def confirms(self, mac: bytes) -> bool:
        """Return whether the other end's CONFIRM shows that it holds the key and has seen the same two HELLOs."""
        return hmac.compare_digest(mac, self._mac(self._their_confirm))

    def seal(self, chunks: list[bytes], confirm: bytes) -> bytes:
        """Frames as they go onto the wire: with a tag behind all that follow our CONFIRM frame."""
        sealed = []
        for frame in chunks:
            sealed.append(seal(frame, self.outbound) if self._sealing else frame)
            self._sealing = self._sealing or frame is confirm
        return b"".join(sealed)

    def _mac(self, key: bytes) -> bytes:
        mac = hmac.digest(key, self._transcript, "sha256")
        assert len(mac) == MAC_SIZE
        return mac
