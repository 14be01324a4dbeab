"""The text and JSON of a sample of the bus. Whatever the payload is, it can be shown."""

import json
import re
import struct
import time
from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple

from swarm.core.lockstep.frames import STEP, WANT
from swarm.errors import PayloadError
from swarm.messages import read, type_of
from swarm.messages.codec import MAX_PAYLOAD, unpack
from swarm.messages.json_values import cut, json_value
from swarm.messages.keys import parse
from swarm.process.text import printable

_SHOWN_BYTES = 48
"""The most bytes of a raw payload that are shown on a terminal; JSON has all of them."""

_SIMPLE = re.compile(r"[A-Za-z0-9_./:+-]+")
_FRAME = struct.Struct("<BI")
_FRAME_KINDS = {STEP: "STEP", WANT: "WANT"}


_LETTERS = "dfqQbBiIhH?"
_ROLL = 32
"""Bytes behind a latest state: a bit for each robot that has been there."""
_ENTRY = re.compile(r"([0-9]{0,3})([a-zA-Z?])")

Layouts = Mapping[str, str]
"""The layout of an app's states in its frames: `AppParameters.states`."""


class BusSample(NamedTuple):
    """One sample with its time and the robot on whose bus it came."""

    time: float
    """Seconds since 1970."""
    robot: str
    """The simulated robot whose bus it came over; empty where there is only one bus."""
    key: str
    payload: bytes
    layouts: Layouts = MappingProxyType({})
    """The layouts of the app to which the frame belongs, as far as they are known."""


def as_text(sample: BusSample) -> str:
    """Return a sample as one line: time, bus, key and the decoded payload."""
    return f"{clock_text(sample.time)} {_bus(sample.robot)}{_word(sample.key)} {_payload_text(sample)}"


def as_json(sample: BusSample) -> str:
    """Return a sample as one JSON object. `value` is the decoded payload; a payload with an error has `hex` and
    `error`. A frame between apps has its kind, number and state, or `hex` where its layout is unknown."""
    data: dict[str, object] = {"time": round(sample.time, 6), "robot": sample.robot, "key": sample.key}
    if (frame := _frame(sample)) is not None:
        kind, name, number, state = frame
        data |= {"frame": kind, name: number, "bytes": len(sample.payload)}
        data |= {"state": json_value(state)} if state is not None else {"hex": sample.payload.hex()}
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
    """Return one line with a key's samples and bytes a second."""
    return f"{clock_text(now)} {_bus(robot)}{_word(key)} {rate:.1f}/s {volume:.0f} B/s"


def rate_json(now: float, robot: str, key: str, rate: float, volume: float) -> str:
    """Return a key's samples and bytes a second as one JSON object."""
    data = {"time": round(now, 6), "robot": robot, "key": key, "rate": rate, "bytes_per_s": volume}
    return json.dumps(data)


def clock_text(seconds: float) -> str:
    """Return the local time of day with milliseconds."""
    return time.strftime("%H:%M:%S", time.localtime(seconds)) + f".{int(seconds % 1 * 1000):03d}"


def _payload_text(sample: BusSample) -> str:
    if (frame := _frame(sample)) is not None:
        kind, name, number, state = frame
        shown = _raw(sample.payload) if state is None else value_text(state) if state else ""
        return f"{kind} {name}={number} {shown}".rstrip()
    try:
        value = unpack(sample.payload)
    except PayloadError as error:
        return f"{_raw(sample.payload)} ({printable(str(error))})"
    fault = _fault(sample)
    return value_text(value) + (f" (! {printable(fault)})" if fault is not None else "")


def frame_app(key: str) -> str:
    """Return the app whose frames between robots come under this key; empty for other keys."""
    try:
        _, service, topic = parse(key)
    except PayloadError:
        return ""
    chunks = topic.split("/")
    return chunks[0] if service == "app" and len(chunks) >= 3 and chunks[1] in ("sync", "latest") else ""


def _frame(sample: BusSample) -> tuple[str, str, int, dict[str, object] | None] | None:
    """Return kind, `k` or `sequence`, that number and the state of an app-to-app frame
    (docs/reference/network/lockstep.md). None in place of the state where its layout is not known; None for other
    keys."""
    try:
        _, service, topic = parse(sample.key)
    except PayloadError:
        return None
    chunks = topic.split("/")
    if service != "app" or len(chunks) < 3 or len(sample.payload) < _FRAME.size:
        return None
    kind, number = _FRAME.unpack_from(sample.payload)
    body = sample.payload[_FRAME.size :]
    if chunks[1] == "latest":
        return "STATE", "sequence", number, _state({"": sample.layouts.get("", "")}, body, 1, spare=_ROLL)
    if chunks[1] != "sync":
        return None
    if kind == WANT and not body:
        return "WANT", "k", number, {}
    state = _state(sample.layouts, body, 2 if number else 1, spare=0) if kind == STEP else None
    return _FRAME_KINDS.get(kind, f"kind {kind}"), "k", number, state


def _state(layouts: Layouts, body: bytes, copies: int, *, spare: int) -> dict[str, object] | None:
    """Return the first of so many equally long states in a frame's body, by the one layout that fits its length; at
    most `spare` bytes may follow."""
    fitting = {text for text in layouts.values() if text and 0 <= len(body) - copies * _size(text) <= spare}
    if len(fitting) != 1:
        return None
    (layout,) = fitting
    found: dict[str, object] = {}
    at = 0
    for name, letters in (each.split("=", 1) for each in layout.split()):
        entries = struct.unpack_from(f"<{letters}", body, at)
        at += struct.calcsize(f"<{letters}")
        found[name] = entries[0] if len(entries) == 1 else list(entries)
    return found


def _size(layout: str) -> int:
    """Return the bytes of a state. For a text that is no layout, as another robot may send one, they are more than any
    state has."""
    size = 0
    for each in layout.split():
        match = _ENTRY.fullmatch(each.partition("=")[2])
        if match is None or match[2] not in _LETTERS:
            return MAX_PAYLOAD + 1
        size += struct.calcsize(f"<{match[0]}")
    return size


def _fault(sample: BusSample) -> str | None:
    """Return why the payload is not what its key demands; None where it is, or where the key is none of ours."""
    try:
        if type_of(sample.key) is not None:
            read(sample.key, sample.payload)
    except PayloadError as error:
        return str(error).removeprefix(f"{sample.key}: ")
    return None


def value_text(value: object, depth: int = 0) -> str:
    """Return a msgpack value as short text: `t=1.5 mode=idle ranges=[{anchor=C933 distance=1.2}]`."""
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
    """Return a text, quoted where it is not simple: it must not steer the terminal."""
    return text if _SIMPLE.fullmatch(text) else json.dumps(text).replace("\x7f", "\\u007f")


def _raw(payload: bytes) -> str:
    more = "..." if len(payload) > _SHOWN_BYTES else ""
    return f"{len(payload)} bytes 0x{payload[:_SHOWN_BYTES].hex()}{more}"


def _bus(robot: str) -> str:
    return f"[{robot}] " if robot else ""
