"""Intel HEX, as avr-objcopy writes it: the bytes of a program memory, or a line that is wrong.

Source: Intel, Hexadecimal Object File Format Specification, revision A (1988). A line is a colon, count, address (two
bytes, high first), type, data and a sum that makes all bytes add up to 0.
"""

import contextlib

from swarm.errors import LocalError

DATA, END, SEGMENT, START_SEGMENT, LINEAR, START_LINEAR = range(6)
_LENGTHS = {END: 0, SEGMENT: 2, START_SEGMENT: 4, LINEAR: 2, START_LINEAR: 4}

ERASED = 0xFF
"""The value of an erased byte of flash."""


def parse(text: str, limit: int) -> bytes:
    """Return the memory from address 0 to the last byte that the file names, gaps erased.

    Raises `LocalError` that names the line: a wrong sum, a byte at `limit` or above, one that is given twice, or an
    end that is missing or not the end.
    """
    memory: dict[int, int] = {}
    base, ended = 0, False
    for number, line in enumerate(text.splitlines(), 1):
        if not line.strip():
            continue
        if ended:
            raise LocalError(f"line {number}: something behind the end")
        kind, address, data = _record(number, line.strip())
        if kind == DATA:
            for offset, byte in enumerate(data):
                at = base + (address + offset) % 0x10000
                if at >= limit:
                    raise LocalError(f"line {number}: a byte at {at:#x}; there is room for {limit} bytes: too large")
                if memory.setdefault(at, byte) != byte:
                    raise LocalError(f"line {number}: another byte at {at:#x} than before")
        elif kind == SEGMENT:
            base = int.from_bytes(data) << 4
        elif kind == LINEAR:
            base = int.from_bytes(data) << 16
        ended = kind == END
    if not ended:
        raise LocalError("no end: the file is not whole")
    if not memory:
        raise LocalError("no bytes in it")
    return bytes(memory.get(at, ERASED) for at in range(max(memory) + 1))


def _record(number: int, line: str) -> tuple[int, int, bytes]:
    """Type, address and data of one line."""
    content = b""
    if line.startswith(":") and line.isascii():
        with contextlib.suppress(ValueError):
            content = bytes.fromhex(line[1:]) if not any(map(str.isspace, line)) else b""
    if len(content) < 5 or len(content) != content[0] + 5:
        raise LocalError(f"line {number}: no Intel HEX: {line[:60]!r}")
    if sum(content) % 256:
        raise LocalError(f"line {number}: its sum is wrong")
    kind, data = content[3], content[4:-1]
    if kind > START_LINEAR or _LENGTHS.get(kind, len(data)) != len(data):
        raise LocalError(f"line {number}: a record of type {kind} with {len(data)} bytes: there is none")
    return kind, int.from_bytes(content[1:3]), data
