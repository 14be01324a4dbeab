"""Names and texts in the overlays' packets, and a reader that raises `FrameError` for whatever is none."""

import struct
from functools import lru_cache

from swarm.errors import FrameError, PayloadError
from swarm.messages.keys import is_name, parse


def packed(text: str, limit: int = 16) -> bytes:
    """A text behind its length, u8; cut off at `limit` bytes."""
    data = text.encode()
    if len(data) > limit:
        data = data[:limit].decode(errors="ignore").encode()
    return bytes((len(data),)) + data


@lru_cache(maxsize=4096)
def _name(data: bytes) -> str:
    """A robot's name. There are few and they come often."""
    text = data.decode("ascii", "replace")
    if not is_name(text):
        raise FrameError(f"{data!r} is not a robot's name")
    return text


class Reader:
    """Goes through a packet; raises `FrameError` where it ends too early."""

    def __init__(self, data: bytes, at: int) -> None:
        self._data = data
        self.at = at

    def unpack(self, layout: struct.Struct) -> tuple[int, ...]:
        """The next numbers."""
        end = self.at + layout.size
        if end > len(self._data):
            raise self._short()
        fields = layout.unpack_from(self._data, self.at)
        self.at = end
        return fields

    def name(self, *, empty: bool = False) -> str:
        """The next robot's name."""
        data = self._text(16)
        return "" if empty and not data else _name(data)

    def text(self, limit: int) -> str:
        """The next text, of at most `limit` bytes."""
        try:
            return self._text(limit).decode()
        except UnicodeDecodeError:
            raise FrameError("overlay packet: a text is not UTF-8") from None

    def key(self) -> str:
        """The next key."""
        text = self.text(255)
        try:
            parse(text)
        except PayloadError as error:
            raise FrameError(f"overlay packet: {error}") from None
        return text

    def octets(self) -> bytes:
        """The next bytes behind their length, u8."""
        return self._text(255)

    def end(self) -> None:
        """Nothing may follow."""
        if self.at != len(self._data):
            raise FrameError(f"overlay packet of {len(self._data)} bytes: {len(self._data) - self.at} too many")

    def _text(self, limit: int) -> bytes:
        if self.at >= len(self._data):
            raise self._short()
        start = self.at + 1
        end = start + self._data[self.at]
        if end - start > limit:
            raise FrameError(f"overlay packet: a text of {end - start} bytes, at most {limit} are allowed")
        if end > len(self._data):
            raise self._short()
        self.at = end
        return self._data[start:end]

    def _short(self) -> FrameError:
        return FrameError(f"overlay packet of {len(self._data)} bytes ends too early")
