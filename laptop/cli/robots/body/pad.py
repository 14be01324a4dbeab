"""`swarm pad [DEVICE] | swarm drive ROBOT`: drive by game pad, with its shoulder button as the dead-man's key.

The pad is read by Linux' joystick interface (Documentation/input/joydev/joystick-api.rst), and its stick becomes the
keys that `swarm drive` takes. Keys come only while a shoulder button is held. Where the pad is unplugged the keys end,
and `swarm drive` with them.
"""

import argparse
import contextlib
import os
import select
import struct
import sys
import time
from pathlib import Path

from swarm.errors import LocalError

HELP = "turn a game pad into keys: swarm pad | swarm drive r2"

DEVICE = Path("/dev/input/js0")
EVENT = struct.Struct("<IhBB")
"""An event of the pad: time in ms, value, kind, number of the axis or button."""
AXIS, BUTTON, AT_START = 0x02, 0x01, 0x80
"""Kinds of events. The last one is added to the kind of events that report the state at the start."""
SIDEWAYS, UPRIGHT = (0, 6), (1, 7)
"""Axes of the left stick and of the cross: to the right and down are positive."""
SHOULDERS = (4, 5)
STOPS = (0, 1, 2, 3)
"""The four buttons at the right. Each of them stops all robots."""
THRESHOLD = 16384
"""Half of the way of a stick, from which on it counts as moved."""

REPEAT_S = 0.1
"""Seconds between two keys: `swarm drive` holds a repeated key for 0.2 s."""
KEYS = {(1, 0): "w", (-1, 0): "s", (0, 1): "a", (0, -1): "d", (1, 1): "q", (1, -1): "e", (-1, 1): "s", (-1, -1): "s"}
"""The key of each direction, by forward and left."""
RELEASE, STOP = ".", " "
"""A key that is no direction ends the motion at once."""


class PadKeys:
    """The key that the state of a pad stands for."""

    def __init__(self) -> None:
        self._axes: dict[int, int] = {}
        self._held: set[int] = set()

    @property
    def key(self) -> str:
        """Return the key of the direction that is held; empty where none is held, or no shoulder button."""
        if not self._held.intersection(SHOULDERS):
            return ""
        return KEYS.get((-self._way(UPRIGHT), -self._way(SIDEWAYS)), "")

    def take(self, event: bytes) -> str:
        """Take an event of the pad. Return `STOP` where the event asks for a stop, else an empty text."""
        _, value, kind, number = EVENT.unpack(event)
        if kind & ~AT_START == AXIS:
            self._axes[number] = value
        elif kind & ~AT_START == BUTTON:
            (self._held.add if value else self._held.discard)(number)
            return STOP if value and number in STOPS and not kind & AT_START else ""
        return ""

    def _way(self, axes: tuple[int, ...]) -> int:
        """Return 1, 0 or -1 as the first of these axes says that is not in its middle."""
        values = (self._axes.get(axis, 0) for axis in axes)
        return next((1 if value > 0 else -1 for value in values if abs(value) >= THRESHOLD), 0)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the pad's device."""
    parser.add_argument("device", nargs="?", type=Path, default=DEVICE, metavar="DEVICE", help=f"the pad ({DEVICE})")


def run(args: argparse.Namespace) -> int:
    """Write keys to the standard output until the pad is unplugged, or nobody reads them."""
    if sys.stdout.isatty():
        raise LocalError("the keys are for another command: swarm pad | swarm drive ROBOT")
    try:
        pad = os.open(args.device, os.O_RDONLY)
    except OSError as error:
        raise LocalError(f"{args.device}: {error.strerror}; is a game pad plugged in? name its device") from None
    with contextlib.closing(os.fdopen(pad, "rb", buffering=0)), contextlib.suppress(BrokenPipeError):
        _write_keys(pad)
    return 0


def _write_keys(pad: int) -> None:
    state, before, due = PadKeys(), "", 0.0
    while True:
        said = ""
        if select.select([pad], [], [], max(0.0, due - time.monotonic()) if before else None)[0]:
            try:
                event = os.read(pad, EVENT.size)
            except OSError:  # it was unplugged
                return
            if len(event) < EVENT.size:
                return
            said = state.take(event)
            if not said and state.key == before and (not before or time.monotonic() < due):
                continue  # a stick that is held trembles: its events must not keep the key from being repeated
        said = said or state.key or RELEASE
        before, due = state.key, time.monotonic() + REPEAT_S
        os.write(sys.stdout.fileno(), said.encode())
