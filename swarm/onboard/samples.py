"""How a sample of the bus looks on a terminal and as JSON. Whatever the payload is, it can be shown."""

import json
import re
import struct
import time
from typing import NamedTuple

from swarm.core.lockstep_frames import STEP, WANT
from swarm.errors import PayloadError
from swarm.messages import read, type_of
from swarm.messages.codec import unpack
from swarm.messages.json_values import cut, json_value
from swarm.messages.keys import parse
from swarm.process.text import printable

_SHOWN_BYTES = 48
"""Bytes of a raw payload on a terminal; JSON has all."""

_SIMPLE = re.compile(r"[A-Za-z0-9_./:+-]+")
_FRAME = struct.Struct("<BI")
_FRAME_KINDS = {STEP: "STEP", WANT: "WANT"}


class BusSample(NamedTuple):
    """What came, when, and on whose bus."""

    time: float
    """Seconds since 1970."""
    robot: str
    """The simulated robot whose bus it came over; empty where there is only one bus."""
    key: str
    payload: bytes


def as_text(sample: BusSample) -> str:
    """One line: time, bus, key and the decoded payload."""
    return f"{clock_text(sample.time)} {_bus(sample.robot)}{_word(sample.key)} {_payload_text(sample)}"


def as_json(sample: BusSample) -> str:
    """One JSON object: `value` is the decoded payload, or `hex` the raw one beside `error` or a frame's head."""
    data: dict[str, object] = {"time": round(sample.time, 6), "robot": sample.robot, "key": sample.key}
    if (frame := _frame(sample)) is not None:
        data |= {"frame": frame[0], frame[1]: frame[2], "bytes": len(sample.payload), "hex": sample.payload.hex()}
    else:
        try:
            data["value"] = json_value(unpack(sample.payload))
        except PayloadError as error:
            data |= {"error": str(error), "bytes": len(sample.payload), "hex": sample.payload.hex()}
        else:
            if (fault := _fault(sample)) is not None:
                data["error"] = fault
    return json.dumps(data)


def rate_text(now: float, robot: str, key: str, rate: float, volume: float) -> str:
    """One line: samples and bytes a second of one key."""
    return f"{clock_text(now)} {_bus(robot)}{_word(key)} {rate:.1f}/s {volume:.0f} B/s"


def rate_json(now: float, robot: str, key: str, rate: float, volume: float) -> str:
    """The same as one JSON object."""
    data = {"time": round(now, 6), "robot": robot, "key": key, "rate": rate, "bytes_per_s": volume}
    return json.dumps(data)


def clock_text(seconds: float) -> str:
    """Local time of day with milliseconds."""
    return time.strftime("%H:%M:%S", time.localtime(seconds)) + f".{int(seconds % 1 * 1000):03d}"


def _payload_text(sample: BusSample) -> str:
    if (frame := _frame(sample)) is not None:
        return f"{frame[0]} {frame[1]}={frame[2]} {_raw(sample.payload)}"
    try:
        value = unpack(sample.payload)
    except PayloadError as error:
        return f"{_raw(sample.payload)} ({printable(str(error))})"
    fault = _fault(sample)
    return value_text(value) + (f" (! {printable(fault)})" if fault is not None else "")


def _frame(sample: BusSample) -> tuple[str, str, int] | None:
    """Kind and iteration, or sequence, of an app-to-app frame (docs/lockstep.md, docs/events.md), None for everything
    else."""
    try:
        _, service, topic = parse(sample.key)
    except PayloadError:
        return None
    chunks = topic.split("/")
    if service != "app" or len(chunks) < 3 or len(sample.payload) < _FRAME.size:
        return None
    kind, number = _FRAME.unpack_from(sample.payload)
    if chunks[1] == "sync":
        return _FRAME_KINDS.get(kind, f"kind {kind}"), "k", number
    return ("STATE", "sequence", number) if chunks[1] == "latest" else None


def _fault(sample: BusSample) -> str | None:
    """Why the payload is not what its key demands; None where it is, or where the key is none of ours."""
    try:
        if type_of(sample.key) is not None:
            read(sample.key, sample.payload)
    except PayloadError as error:
        return str(error).removeprefix(f"{sample.key}: ")
    return None


def value_text(value: object, depth: int = 0) -> str:
    """A msgpack value in short: `t=1.5 mode=idle ranges=[{anchor=C933 distance=1.2}]`."""
    if isinstance(value, dict):
        inner = " ".join(f"{_word(str(name))}={value_text(item, depth + 1)}" for name, item in cut(value, depth))
        return inner if depth == 0 and inner else "{" + inner + "}"
    if isinstance(value, list):
        return "[" + " ".join(value_text(item, depth + 1) for _, item in cut(value, depth)) + "]"
    if value is None:
        return "-"
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, float):
        # The digits of a clock that counts from the start of the machine need not be cut off.
        return f"{value:.3f}" if 1000 <= abs(value) < 1e9 else f"{value:.4g}"
    if isinstance(value, bytes):
        return _raw(value)
    return str(value) if isinstance(value, int) else _word(str(value))


def _word(text: str) -> str:
    """Text as it is where it is simple, else quoted: it must not steer the terminal."""
    return text if _SIMPLE.fullmatch(text) else json.dumps(text).replace("\x7f", "\\u007f")


def _raw(payload: bytes) -> str:
    more = "..." if len(payload) > _SHOWN_BYTES else ""
    return f"{len(payload)} bytes 0x{payload[:_SHOWN_BYTES].hex()}{more}"


def _bus(robot: str) -> str:
    return f"[{robot}] " if robot else ""
