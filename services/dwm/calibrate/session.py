"""A guided session between a person, a robot on its bus, and a file of samples.

The person presses the robot's buttons (A: start and stop, B: next place, C: this place anew) or keys. Every sample is
written at once, and what is to be measured anew leaves the file at once: whatever happens to the session, what was
measured is there and nothing else.
"""

import os
import queue
import select
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TextIO

from services.dwm.core.calibration.guide import Guide, GuideButton
from services.dwm.core.calibration.samples import HEADER, write
from swarm.bus.zenoh_bus import Bus
from swarm.errors import BusError, LocalError
from swarm.files import atomic_write
from swarm.messages import Buttons, Pose, Ranges
from swarm.messages.codec import decoded
from swarm.messages.keys import key
from swarm.onboard.body import keyboard

KEYS = {
    " ": GuideButton.START, "\n": GuideButton.START, "\r": GuideButton.START, "s": GuideButton.START,
    "n": GuideButton.NEXT, "r": GuideButton.REDO, "q": GuideButton.QUIT, "\x04": GuideButton.QUIT,
}  # fmt: skip
"""The meaning of each key. Of a line from a pipe the first letter counts, and an empty line starts a measurement."""

HELP = "space or button A: start, stop   n or B: next place   r or C: place anew   q: end"

SILENT = 5.0
"""Seconds without a report after which the session says so."""

_POLL = 0.1

Message = Ranges | Pose | Buttons


class Hearing:
    """The messages of one robot on the bus, in order."""

    def __init__(self, bus: Bus, robot: str) -> None:
        self.messages: queue.SimpleQueue[Message] = queue.SimpleQueue()
        bus.subscribe(key(robot, "dwm", "ranges"), decoded(Ranges, self.messages.put))
        bus.subscribe(key(robot, "dwm", "pose"), decoded(Pose, self.messages.put))
        bus.subscribe(key(robot, "balancer", "buttons"), decoded(Buttons, self.messages.put))


class Reports:
    """Joins ranges and pose of a report and leaves out what was there before."""

    def __init__(self) -> None:
        self._ranges: Ranges | None = None
        self._seen: dict[str, int] = {}

    def take(self, message: Ranges | Pose) -> tuple[float, list[tuple[str, float]], tuple[float, float] | None] | None:
        """Time, new ranges and raw place of a report that is whole with `message`; else None."""
        if isinstance(message, Ranges):
            self._ranges = message
            return None
        ranges, self._ranges = self._ranges, None
        if ranges is None or ranges.sequence != message.sequence:
            return None
        new = [item for item in ranges.ranges if self._seen.get(item.anchor) != item.sequence and not item.stale]
        self._seen.update((item.anchor, item.sequence) for item in ranges.ranges)
        raw_x, raw_y = message.raw_x, message.raw_y
        place = (raw_x, raw_y) if raw_x is not None and raw_y is not None else None
        return ranges.t, [(item.anchor, item.raw) for item in new], place


class Presses:
    """Counts of the robot's buttons: a press that was missed still shows."""

    def __init__(self) -> None:
        self._last: tuple[int, int, int] | None = None

    def take(self, message: Buttons) -> list[GuideButton]:
        """Return the buttons that were pressed since the message before."""
        counts = message.presses
        last, self._last = self._last, counts
        if last is None or any(new < old for new, old in zip(counts, last, strict=True)):
            return []  # the first message, or the balancer began anew
        meanings = (GuideButton.START, GuideButton.NEXT, GuideButton.REDO)
        return [what for what, new, old in zip(meanings, counts, last, strict=True) for _ in range(new - old)]


class KeyPresses:
    """Keys of a terminal as they are pressed; of a pipe, a line whenever the guide waits for one."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self._is_terminal = stream.isatty()
        self._rest = b""
        self._ended = False

    def pressed(self, wait: float, *, waiting: bool) -> GuideButton | None:
        """Return the key pressed within `wait` s. A pipe is only read while the guide is `waiting`; its end means
        quit."""
        if not self._is_terminal and not waiting:
            return None
        if b"\n" not in self._rest and not self._ended:
            if not select.select([self._stream], [], [], wait)[0]:
                return None
            data = os.read(self._stream.fileno(), 4096)
            self._ended = not data
            self._rest += data
        if self._is_terminal:
            text, self._rest = self._rest.decode(errors="replace"), b""
            return next((KEYS[letter] for letter in text.lower() if letter in KEYS), None)
        line, end, rest = self._rest.partition(b"\n")
        if not end:
            return GuideButton.QUIT if self._ended else None
        self._rest = rest
        return KEYS.get((line.decode(errors="replace").strip().lower() + "\n")[0])


def hold(
    guide: Guide, hearing: Hearing, module: str, path: Path, say: Callable[[str], None], now: Callable[[], float]
) -> None:
    """Run the session until it is done; samples are appended to `path`. Raises `BusError` where nothing is heard."""
    reports, presses, keys = Reports(), Presses(), KeyPresses(sys.stdin)

    def press(button: GuideButton) -> None:
        there = len(guide.samples)
        guide.press(button)
        if len(guide.samples) < there:
            _write(path, guide)

    _new(path)
    with keyboard.Keyboard(sys.stdin).raw():
        say(HELP)
        heard_at, shown = now(), ""
        while not guide.done:
            if (prompt := f"{guide.prompt()}: {'measuring' if guide.measuring else 'start?'}") != shown:
                say(prompt)
                shown = prompt
            pressed = keys.pressed(0.0 if guide.measuring else _POLL, waiting=not guide.measuring)
            if pressed is not None:
                press(pressed)
            for message in _drained(hearing.messages, _POLL if guide.measuring else 0.0):
                if isinstance(message, Buttons):
                    for button in presses.take(message):
                        press(button)
                    continue
                report = reports.take(message)
                if report is None:
                    continue
                heard_at = now()
                place = guide.stop.place if not guide.done else -1
                made = guide.report(*report)
                if made:
                    with path.open("a", encoding="utf-8") as file:
                        file.writelines(write(sample) + "\n" for sample in made)
                    say("  " + (guide.progress(module) if not guide.done and guide.measuring else f"place {place + 1}"))
            if now() - heard_at > SILENT and guide.measuring:
                raise BusError(
                    f"no report of the robot's module for {SILENT:g} s: does its dwm service run? See swarm dwm check"
                )
    _write(path, guide)


def _new(path: Path) -> None:
    try:
        with path.open("x", encoding="utf-8") as file:
            file.write(HEADER + "\n")
    except FileExistsError:
        raise LocalError(f"{path}: is there already; name another file with --samples") from None


def _drained(messages: "queue.SimpleQueue[Message]", wait: float) -> Iterator[Message]:
    """Yield the messages that wait; where none waits, those that come within `wait` s."""
    try:
        yield messages.get(timeout=wait) if wait else messages.get_nowait()
        while True:
            yield messages.get_nowait()
    except queue.Empty:
        return


def _write(path: Path, guide: Guide) -> None:
    """Bring all samples of the session to the disk, without those of places that are measured anew."""
    lines = [HEADER, *map(write, guide.samples)]
    atomic_write(path, ("\n".join(lines) + "\n").encode())
