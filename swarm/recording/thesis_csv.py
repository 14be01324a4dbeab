"""The CSV layouts of R. Englebert's thesis: what a line of each says, and how a run of ours is told in them.

A folder holds `<k>.csv` for robot k (of LEDs: in `frequency/` and `phase/`), without header; times are Unix seconds.

    t, value[, flag]                                  consensus, LEDs, stand-up, flooding, unicast, asynchronous;
                                                      flag 0: a new state, 1: it was sent; the first line is state 0
    t, x, y, zx, zy, gx, gy[, flag[, cost, distance, own_x, own_y]]     localization, cm; flag as above
    t, x, y, zx, zy, gx, gy[, cost]                   localization, first trials, m
    round-trip time                                   RTT<bytes>.csv, s
    k | distance, x, y                                calibration (full.csv): a place's number, or a sample there, mm
"""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import PurePosixPath
from typing import NamedTuple

from swarm.errors import RecordingError
from swarm.recording.thesis_ranges import LATEST_S, cost, finite

FOLDERS = ("consensus", "led_sync", "localization", "flooding", "unicast", "async", "standup", "latency", "calibration")
"""Names of the thesis' folders: what was measured."""
TRUTHS = {"flooding": "ready", "unicast": "ready", "standup": "standing", "async": "value"}
"""The name of the field that a truth value in the file stands for, by the kind of run."""
CHANNELS = ("frequency", "phase")
"""Folders within one of LEDs."""

_CM = 100.0
_LOCALIZATION = ("x", "y", "zx", "zy", "gx", "gy")


class _Line(NamedTuple):
    """The values of one line."""

    t: float | None
    """Unix time, s; None where the layout has none."""
    k: int | None
    """The iteration whose state it brings; None where it brings none."""
    state: dict[str, float | bool]
    result: dict[str, float | bool]
    measurement: tuple[float, float, float] | None
    """Distance to the target and own place, m, that made this state."""


def kind_of(path: PurePosixPath) -> str:
    """Return the kind of measurement by the folders of a file; `consensus` where they do not tell it."""
    if path.stem.startswith("RTT"):
        return "latency"
    return next((part for part in reversed(path.parts) if part in FOLDERS), "consensus")


def robot_of(path: PurePosixPath) -> str:
    """Return the robot that a file is of."""
    return f"r{int(path.stem)}" if path.stem.isdecimal() else "r0"


def channel_of(path: PurePosixPath) -> str:
    """Return the app's channel that a file is of, empty for none."""
    return path.parent.name if path.parent.name in CHANNELS else ""


def read(text: str, kind: str, name: str) -> Iterator[tuple[str, _Line]]:
    """Yield each line with its ending and its values. `RecordingError` names file and line."""
    lines = text.splitlines(keepends=True)
    metres = kind == "localization" and not any(line.count(",") == 11 for line in lines)
    k = -1
    for number, raw in enumerate(lines, 1):
        try:
            cells = [_cell(cell) for cell in raw.rstrip("\r\n").split(",")]
            line = _line(cells, kind, k, metres=metres)
        except ValueError as error:
            raise RecordingError(f"{name}:{number}: {error}") from None
        if line.k is not None:
            k = line.k
        yield raw, line


def _cell(text: str) -> float | bool:
    if text in ("True", "False"):
        return text == "True"
    value = finite(text)
    if value is None:
        raise ValueError(f"{text[:40]!r} is no number")
    return value


def _line(cells: Sequence[float | bool], kind: str, k: int, *, metres: bool) -> _Line:
    nothing: dict[str, float | bool] = {}
    if kind in ("latency", "calibration"):
        if len(cells) not in ((1,) if kind == "latency" else (1, 3)):
            raise ValueError(f"{len(cells)} columns are none of {kind}")
        names = ("rtt",) if kind == "latency" else ("place",) if len(cells) == 1 else ("distance", "x", "y")
        return _Line(None, k + 1, dict(zip(names, cells, strict=True)), nothing, None)
    t = float(cells[0])
    if not 0.0 <= t < LATEST_S:
        raise ValueError(f"{t:g} is no time in s")
    if kind == "localization":
        if len(cells) not in (7, 8, 12):
            raise ValueError(f"{len(cells)} columns are none of localization, expected 7, 8 or 12")
        state = dict(zip(_LOCALIZATION, cells[1:7], strict=True))
        scale = 1.0 if metres else _CM
        result = {"x": cells[1] / scale, "y": cells[2] / scale}
        if metres and k >= 0 and len(cells) == 8:
            return _Line(t, k + 1, state, {**result, "cost": cells[7]}, None)
        new = k < 0 or (len(cells) > 7 and cells[7] == 0)
        measured = (cells[9] / _CM, cells[10] / _CM, cells[11] / _CM) if len(cells) == 12 else None
        result["cost"] = cells[8] / _CM**4 if len(cells) == 12 else 0.0
        return _Line(t, k + 1 if new else None, state, result, measured if new else None)
    if len(cells) not in (2, 3):
        raise ValueError(f"{len(cells)} columns are none of {kind}, expected 2 or 3")
    new = k < 0 or len(cells) == 2 or cells[2] == 0 or kind not in ("consensus", "led_sync")
    name = TRUTHS.get(kind, "value") if isinstance(cells[1], bool) else "value"
    return _Line(t, k + 1 if new else None, {name: cells[1]}, nothing, None)


def states(rows: Sequence[tuple[float, Sequence[str]]]) -> str:
    """Return a robot's states (Unix time, cells) in the layout of consensus: new, and sent at once."""
    text = ""
    for k, (t, cells) in enumerate(rows):
        line = ",".join((repr(t), *cells))
        text += f"{line}\n" if k == 0 else f"{line},0\n{line},1\n"
    return text


def localization(
    rows: Sequence[tuple[int, float, float, float]], measurements: Mapping[int, tuple[float, float, float]]
) -> str:
    """Return a robot's estimates (k, Unix time, x, y in m) in the layout of localization, with the measurement
    (distance, own x, y, m) that gave state k. z and g are 0: other algorithms have none. The first row is the begin of
    the run; of the others those without a measurement are left out, since the layout has no line for them."""
    text = ""
    for k, t, x, y in rows:
        line = ",".join(map(repr, (t, _CM * x, _CM * y, 0.0, 0.0, 0.0, 0.0)))
        if not text:
            text += f"{line}\n"
        elif k in measurements:
            distance, px, py = (_CM * value for value in measurements[k])
            rest = ",".join(map(repr, (cost(distance, _CM * x, _CM * y, px, py), distance, px, py)))
            text += f"{line},0,{rest}\n{line},1,{rest}\n"
    return text
