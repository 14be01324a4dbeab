"""The progress of a simulation for people: a block that is redrawn on a terminal, plain lines elsewhere."""

import contextlib
import math
import os
from collections.abc import Container, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import TextIO

from sim.processes.monitor import Seen
from sim.scenario.scenario import Scenario
from swarm.messages import AppLog
from swarm.process.terminal import steer
from swarm.process.text import printable

TERMINAL_PERIOD_S = 0.25
PLAIN_PERIOD_S = 2.0


class ProgressDisplay:
    """Draws the state of the run on `stream`, at most every period."""

    def __init__(self, stream: TextIO, scenario: Scenario) -> None:
        self._stream = stream
        self._scenario = scenario
        self._terminal = stream.isatty()
        self._drawn = 0
        self._next = 0.0

    def show(
        self,
        now: float,
        elapsed: float,
        seen: Mapping[str, Seen],
        missing: Mapping[str, Sequence[str]],
        off: Container[str] = (),
    ) -> None:
        """Draw if it is time; `missing` names the services of each robot that are not ready, `off` the robots that are
        switched off: what they have told last holds no more."""
        if now < self._next:
            return
        self._next = now + (TERMINAL_PERIOD_S if self._terminal else PLAIN_PERIOD_S)
        robots = [(name, "off" if name in off else _robot(self._scenario, seen[name], missing[name])) for name in seen]
        if self._terminal:
            lines = [f"{elapsed:6.1f} s", *(f"  {name}  {text}" for name, text in robots)]
            self._erase()
            lines = _fit(lines, self._stream)
            for line in lines:
                _write(self._stream, line)
            self._drawn = len(lines)
        else:
            _write(self._stream, f"{elapsed:6.1f} s  " + "; ".join(f"{name} {text}" for name, text in robots))
        self._stream.flush()

    def say(self, sentence: str) -> None:
        """Print one line that stays."""
        self._erase()
        _write(self._stream, sentence)
        self._stream.flush()

    def pass_on(self, lines: Iterable[tuple[str, AppLog]], began: float) -> None:
        """Print what apps have printed and logged, with the time since `began`."""
        for robot, line in lines:
            self.say(said(robot, replace(line, t=line.t - began)))

    def close(self) -> None:
        """Take the block away: the report follows."""
        self._erase()
        self._stream.flush()

    def _erase(self) -> None:
        if self._drawn:
            steer(self._stream, f"\x1b[{self._drawn}F\x1b[J")
            self._drawn = 0


def said(robot: str, line: AppLog) -> str:
    """Return a line for people with what an app has printed or logged."""
    level = "" if line.level in ("print", "info") else f"{line.level}: "
    return f"{line.t:9.3f} s  {robot}  {level}{line.text}"


def say(out: TextIO, robot: str, line: AppLog) -> None:
    """Print what an app has printed or logged."""
    _write(out, said(robot, line))


def _write(out: TextIO, line: str) -> None:
    """Write one line, whatever others have put into it."""
    out.write(printable(line, None) + "\n")


def _fit(lines: list[str], terminal: TextIO) -> list[str]:
    """Return the lines cut to the width and height of the terminal, since a longer block cannot be erased as a whole. A
    terminal that does not tell its size gets all lines."""
    width, height = 0, 0
    with contextlib.suppress(OSError, ValueError):
        width, height = os.get_terminal_size(terminal.fileno())
    if 1 < height <= len(lines):
        kept = lines[: max(1, height - 2)]
        lines = [*kept, f"  ... and {len(lines) - len(kept)} more robots"]
    return [printable(line, max(3, width) if width else None) for line in lines]


def _robot(scenario: Scenario, seen: Seen, missing: Sequence[str]) -> str:
    parts = []
    if missing:
        parts.append("starting " + ", ".join(missing))
    if seen.balancer is not None:
        body = seen.balancer
        parts.append(body.fault or f"{body.mode.replace('_', ' ')} {math.degrees(body.tilt):+.1f} deg")
    if seen.links is not None:
        away = [link.peer for link in seen.links.links if link.state != "up"]
        if away:
            parts.append("no link to " + ", ".join(away))
    if seen.progress is not None:
        parts.append(_app(scenario, seen))
    return ", ".join(parts) or "starting"


def _app(scenario: Scenario, seen: Seen) -> str:
    progress, state = seen.progress, seen.state
    assert progress is not None
    text = f"k={max(progress.k, state.k if state is not None else 0)}"
    if progress.waiting_for:
        text += f" waits for {', '.join(progress.waiting_for)}"
        text += f" ({progress.reason})" if progress.reason else ""
    elif progress.phase != "running":
        text += f" {progress.phase} {progress.reason}".rstrip()
    if state is None:
        return text
    if scenario.built_in == "localization":
        x, y = state.result.get("x"), state.result.get("y")
        if isinstance(x, float) and isinstance(y, float) and not scenario.config.simulation.moving:
            text += f" error {100 * math.dist((x, y), scenario.config.simulation.target):.1f} cm"
        return text
    numbers = [f"{name}={value:.4g}" for name, value in state.result.items() if isinstance(value, float | int)]
    return " ".join([text, *numbers[:3]])
