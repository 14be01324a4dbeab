"""Messages of D-Bus as bytes: what pairing needs to speak to bluetoothd, without a library on the robot.

D-Bus Specification 0.43, "Type System", "Marshaling (Wire Format)" and "Message Protocol". Little-endian is written,
both are read. A variant is a pair (signature, value); a dictionary is a dict, a struct a tuple, an array a list.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass, field
from typing import Any

CALL, RETURN, ERROR, SIGNAL = 1, 2, 3, 4
"""Types of messages."""

NO_AUTO_START = 2
"""Flag of a call: a service that does not run is not started for it (it would be waited for for 25 s, in vain)."""

MAX_MESSAGE = 1 << 27
"""Bytes, of the specification."""

_FIXED = {"y": "B", "b": "I", "n": "h", "q": "H", "i": "i", "u": "I", "x": "q", "t": "Q", "d": "d"}
_ALIGN = {"y": 1, "g": 1, "v": 1, "n": 2, "q": 2, "b": 4, "i": 4, "u": 4, "s": 4, "o": 4, "a": 4,
          "x": 8, "t": 8, "d": 8, "(": 8, "{": 8}  # fmt: skip
_FIELDS = {1: ("path", "o"), 2: ("interface", "s"), 3: ("member", "s"), 4: ("error", "s"), 5: ("reply_to", "u"),
           6: ("destination", "s"), 7: ("sender", "s"), 8: ("signature", "g")}  # fmt: skip
_CODES = {name: (code, signature) for code, (name, signature) in _FIELDS.items()}
_MAX_DEPTH = 64


class WireError(Exception):
    """Bytes that are no message, or values that do not fit their signature."""


@dataclass
class DbusMessage:
    """One message; `body` has a value for each complete type of `signature`."""

    kind: int
    serial: int = 0
    fields: dict[str, Any] = field(default_factory=dict)
    """path, interface, member, error, reply_to, destination, sender, signature: those that are there."""
    body: list[Any] = field(default_factory=list)


def split(signature: str) -> list[str]:
    """The complete types that a signature is made of; `WireError` where it is none."""
    types = []
    at = 0
    while at < len(signature):
        end = _end(signature, at, 0)
        types.append(signature[at:end])
        at = end
    return types


def _end(signature: str, at: int, depth: int) -> int:
    """Where the complete type that begins at `at` ends."""
    if at >= len(signature) or depth > _MAX_DEPTH:
        raise WireError(f"signature {signature!r} ends too early, or nests too deeply")
    kind = signature[at]
    if kind in _FIXED or kind in "sogv":
        return at + 1
    if kind == "a":
        return _end(signature, at + 1, depth + 1)
    closing = {"(": ")", "{": "}"}.get(kind)
    if closing is None:
        raise WireError(f"signature {signature!r}: there is no type {kind!r}")
    at += 1
    members = 0
    while at < len(signature) and signature[at] != closing:
        at = _end(signature, at, depth + 1)
        members += 1
    if at >= len(signature) or members == 0 or (kind == "{" and members != 2):
        raise WireError(f"signature {signature!r}: a {kind} that is not closed, or has {members} members")
    return at + 1


def marshal(signature: str, values: list[Any], out: bytearray | None = None) -> bytearray:
    """The values as bytes, after those of `out`, to whose beginning they are aligned."""
    out = bytearray() if out is None else out
    types = split(signature)
    if len(types) != len(values):
        raise WireError(f"{len(values)} values for the signature {signature!r}")
    try:
        for kind, value in zip(types, values):  # noqa: B905 - `strict` came with Python 3.10
            _write(out, kind, value)
    except (struct.error, TypeError, AttributeError, ValueError) as error:
        raise WireError(f"values do not fit the signature {signature!r}: {error}") from None
    return out


def _pad(out: bytearray, kind: str) -> None:
    out.extend(b"\0" * (-len(out) % _ALIGN[kind]))


def _write(out: bytearray, kind: str, value: Any) -> None:
    first = kind[0]
    _pad(out, first)
    if first in _FIXED:
        out += struct.pack("<" + _FIXED[first], value)
    elif first in "so":
        data = value.encode()
        out += struct.pack("<I", len(data)) + data + b"\0"
    elif first == "g":
        data = value.encode()
        out += struct.pack("<B", len(data)) + data + b"\0"
    elif first == "v":
        inner, content = value
        if len(split(inner)) != 1:
            raise WireError(f"a variant of {inner!r}")
        _write(out, "g", inner)
        _write(out, inner, content)
    elif first == "a":
        at = len(out)
        out += b"\0\0\0\0"
        _pad(out, kind[1])
        start = len(out)
        for item in value.items() if kind[1] == "{" else value:
            _write(out, kind[1:], item)
        out[at : at + 4] = struct.pack("<I", len(out) - start)
    else:
        marshal_members = split(kind[1:-1])
        if len(marshal_members) != len(value):
            raise WireError(f"{len(value)} members for {kind!r}")
        for inner, member in zip(marshal_members, value):  # noqa: B905
            _write(out, inner, member)


class _Reader:
    """Values out of bytes."""

    def __init__(self, data: bytes, order: str) -> None:
        self.data, self.order, self.at, self.depth = data, order, 0, 0

    def take(self, count: int) -> bytes:
        if count > len(self.data) - self.at:
            raise WireError("a message that is cut off")
        self.at += count
        return self.data[self.at - count : self.at]

    def align(self, kind: str) -> None:
        if any(self.take(-self.at % _ALIGN[kind])):
            raise WireError("padding that is not zero")

    def number(self, code: str) -> int:
        return int(struct.unpack(self.order + code, self.take(struct.calcsize(code)))[0])

    def values(self, signature: str) -> list[Any]:
        return [self.value(kind) for kind in split(signature)]

    def value(self, kind: str) -> Any:
        self.depth += 1
        if self.depth > _MAX_DEPTH:
            raise WireError("values that nest too deeply")
        try:
            return self._value(kind)
        finally:
            self.depth -= 1

    def _value(self, kind: str) -> Any:
        first = kind[0]
        self.align(first)
        if first in _FIXED:
            code = _FIXED[first]
            (number,) = struct.unpack(self.order + code, self.take(struct.calcsize("=" + code)))
            if first == "b":
                if number > 1:
                    raise WireError(f"a boolean of {number}")
                return bool(number)
            return number
        if first in "sog":
            length = self.number("B" if first == "g" else "I")
            data = self.take(length)
            if self.take(1) != b"\0":
                raise WireError("a text without its end")
            try:
                return data.decode()
            except UnicodeDecodeError:
                raise WireError("a text that is not UTF-8") from None
        if first == "v":
            inner = self.value("g")
            if len(split(inner)) != 1:
                raise WireError(f"a variant of {inner!r}")
            return inner, self.value(inner)
        if first == "a":
            length = self.number("I")
            self.align(kind[1])
            end = self.at + length
            if end > len(self.data):
                raise WireError("an array longer than its message")
            items = []
            while self.at < end:
                items.append(self.value(kind[1:]))
            if self.at != end:
                raise WireError("an array whose last item ends beyond it")
            try:
                return dict(items) if kind[1] == "{" else items
            except TypeError:
                raise WireError("a dictionary with a key that can be none") from None
        return tuple(self.value(inner) for inner in split(kind[1:-1]))


def unmarshal(signature: str, data: bytes, *, little: bool = True) -> list[Any]:
    """The values of a body; raises `WireError`."""
    reader = _Reader(data, "<" if little else ">")
    values = reader.values(signature)
    if reader.at != len(data):
        raise WireError(f"{len(data) - reader.at} bytes too many")
    return values


def encode(message: DbusMessage) -> bytes:
    """A message as bytes; its `signature` must be that of its body."""
    body = marshal(message.fields.get("signature", ""), message.body)
    flags = NO_AUTO_START if message.kind == CALL else 0
    fields = [(_CODES[name][0], (_CODES[name][1], value)) for name, value in message.fields.items()]
    out = bytearray(struct.pack("<cBBBII", b"l", message.kind, flags, 1, len(body), message.serial))
    marshal("a(yv)", [fields], out)
    _pad(out, "(")
    return bytes(out + body)


def size(data: bytes) -> int | None:
    """Bytes of the message that begins here; None where more are needed to tell. Raises `WireError`."""
    if len(data) < 16:
        return None
    if data[:1] not in (b"l", b"B") or data[3] != 1:
        raise WireError("no message of D-Bus version 1")
    order = "<" if data[:1] == b"l" else ">"
    body, _, fields = struct.unpack(order + "III", data[4:16])
    total = 16 + fields + (-fields % 8) + body
    if total > MAX_MESSAGE:
        raise WireError(f"a message of {total} bytes")
    return int(total)


def decode(data: bytes) -> DbusMessage:
    """One whole message; raises `WireError`."""
    if size(data) != len(data):
        raise WireError("not one whole message")
    reader = _Reader(data, "<" if data[:1] == b"l" else ">")
    reader.take(8)
    serial = reader.number("I")
    fields: dict[str, Any] = {}
    for code, (signature, value) in reader.value("a(yv)"):
        name, expected = _FIELDS.get(code, ("", ""))
        if name and signature != expected:
            raise WireError(f"the header's {name} is of type {signature!r}")
        if name:
            fields[name] = value
    reader.align("(")
    body = reader.values(fields.get("signature", ""))
    if reader.at != len(data):
        raise WireError("more bytes than the signature has values")
    return DbusMessage(data[1], serial, fields, body)
