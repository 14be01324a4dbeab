"""The form of keys on the bus: `swarm/<robot>/<service>/<topic...>`. The keys of a service stand with its messages;
docs/reference/keys.md lists every key.

What a robot publishes carries its own name. Commands to a robot go to `swarm/<robot>/<service>/set/<what>`.
`swarm/stop` stops every robot.
"""

import re
from functools import lru_cache
from typing import NamedTuple

from swarm.errors import LocalError, PayloadError

ROOT = "swarm"
STOP = "swarm/stop"
EVERYTHING = "swarm/**"

MAX_KEY_LENGTH = 255
"""Longest key taken from outside, in bytes. Zenoh accepts a key of 65 536 characters and then panics in put,
which poisons the session; 255 is the length its own documentation recommends."""

_NAME = re.compile(r"[a-z][a-z0-9_-]{0,15}")
_CHUNK = re.compile(r"[A-Za-z0-9_.:-]+")
_ANY_KEY = re.compile(r"[A-Za-z0-9_.:-]+(/[A-Za-z0-9_.:-]+)*")


class Key(NamedTuple):
    """A key taken apart. `topic` keeps its slashes, e.g. `set/mode`."""

    robot: str
    service: str
    topic: str

    def __str__(self) -> str:
        return f"{ROOT}/{self.robot}/{self.service}/{self.topic}"


def key(robot: str, service: str, *topic: str) -> str:
    """Build a key; raises `LocalError` where a part is not a valid chunk. Wildcards are allowed."""
    parts = (ROOT, robot, service, *topic)
    for part in "/".join(parts).split("/"):
        if part not in ("*", "**") and not _CHUNK.fullmatch(part):
            raise LocalError(f"key part {part!r} of {'/'.join(parts)!r}: use letters, digits and _ . : -")
    return "/".join(parts)


@lru_cache(maxsize=2048)
def parse(text: str) -> Key:
    """Take a concrete key from the bus or from a peer apart. The same keys come again and again: those are remembered.

    Raises `PayloadError` for a key that is too long, is not below `swarm/`, or has wildcards or odd letters.
    """
    if len(text.encode("utf-8", "surrogatepass")) > MAX_KEY_LENGTH:
        raise PayloadError(f"key {text[:40]!r}...: longer than {MAX_KEY_LENGTH} bytes")
    parts = text.split("/")
    if len(parts) < 4 or parts[0] != ROOT:
        raise PayloadError(f"key {text!r}: expected swarm/<robot>/<service>/<topic>")
    for part in parts:
        if not _CHUNK.fullmatch(part):
            raise PayloadError(f"key {text!r}: chunk {part!r} is not of letters, digits and _ . : -")
    return Key(parts[1], parts[2], "/".join(parts[3:]))


def owner_of(text: str) -> str | None:
    """Return the robot whose name a concrete key carries; None where the text is no such key, see `parse`."""
    try:
        return parse(text).robot
    except PayloadError:
        return None


def whose_token(text: str) -> tuple[str, str]:
    """Robot and service of a liveliness token, e.g. ("r0", "app/consensus") of `swarm/r0/app/consensus/alive`.

    Raises `PayloadError` for a key that is no such token's.
    """
    robot, service, topic = parse(text)
    *more, last = topic.split("/")
    if last != "alive":
        raise PayloadError(f"key {text!r}: expected swarm/<robot>/<service>/alive")
    return robot, "/".join((service, *more))


def is_key(text: str) -> bool:
    """Return whether Zenoh takes it as a key: chunks of letters, digits and `_.:-`, with `/` between them."""
    return len(text) <= MAX_KEY_LENGTH and _ANY_KEY.fullmatch(text) is not None


def is_name(text: str) -> bool:
    """Return whether `text` may name a robot or an app: a lower-case letter, then up to 15 of a-z, 0-9, _ and -."""
    return _NAME.fullmatch(text) is not None
