"""Recordings of the original robots' localization runs, `<index>.csv` for each robot of a run (thesis 4.3.3).

A file's lines, lengths in cm:

    t, x, y, zx, zy, gx, gy                                       line 1: state 0, before any iteration
    t, x, y, zx, zy, gx, gy, 1                                    that state was sent
    t, x, y, zx, zy, gx, gy, 0, cost, distance, own_x, own_y      a new state was computed
    t, x, y, zx, zy, gx, gy, 1, cost, distance, own_x, own_y      that state was sent

The n-th line with flag 0 (n = 0, 1, ...) holds state n+1 and the measurement with which its gradient was
computed. So measurement k, the pair (phi_k, p_k), takes state k to state k+1 (thesis eqs 4.4 to 4.6; w_ij are
row-normalized weights with the robot itself among its neighbours, neighbours' values travel as float32, every
state is zero at k = 0), and it enters only through the last line:

    x_{k+1} = sum_j w_ij x_k^j - z_k - gamma g_k
    z_{k+1} = sum_j w_ij (z_k^j + gamma g_k^j) - gamma g_k
    g_{k+1} = 4 (phi_k^2 - |x_{k+1} - p_k|^2) (p_k - x_{k+1})
"""

import math
from bisect import bisect_left, bisect_right
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from statistics import median, median_low
from typing import NamedTuple

from swarm.errors import RecordingError
from swarm.frozen import frozen

_CM = 100.0

FARTHEST_CM = 1e5
"""UWB reaches no farther, nor is an estimate of any use there."""

LARGEST = 1e22
"""More than any cell holds, in use or not: the cost of such lengths, in cm^4."""

LATEST_S = 9e9
"""The latest time that a recording holds, s since 1970: its times are ns in 64 bits."""

SLOWEST_S = 10.0
"""Half of a run's iterations are quicker: with links as slow as this one no lockstep gets far."""

ODD_PACE = 10.0
"""Factor by which the paces of two robots differ only if their clocks do: in lockstep all are equally fast."""

SHORT_M = 0.05
"""Distances that are all below are none of UWB modules, whose error is as large."""

COST_SHARE = 1e-3
"""Share of the squared lengths by which the cost of a line may differ from theirs: cells rounded to 1 mm keep it."""

_MARK = "\ufffd\ufffd"
"""The beginning of a byte-order mark, of UTF-8 or UTF-16, read as ASCII."""


class ThesisRow(NamedTuple):
    """One measurement of a robot, in m."""

    distance: float
    """Distance to the target."""
    x: float
    """The robot's own place."""
    y: float


@frozen
class ThesisRecording:
    """The measurements and estimates of one robot."""

    path: Path
    rows: tuple[ThesisRow, ...]
    """Row k takes state k to state k+1."""
    times: tuple[float, ...]
    """The time of row k, s after the file's first line."""
    estimates: tuple[tuple[float, float], ...]
    """Estimated place of the target in state k, m: one more than there are rows, the first is the start."""
    began: float = 0.0
    """The time of the file's first line, s."""
    lines: tuple[int, ...] = ()
    """The number of each row's line in the file."""

    @property
    def steps(self) -> int:
        """Return the number of iterations that can be replayed."""
        return len(self.rows)


def read_folder(directory: Path) -> list[ThesisRecording]:
    """Return the recordings of all robots of a run: 0.csv, 1.csv and so on. Raises `RecordingError`."""
    there = {int(path.stem) for path in directory.glob("*.csv") if path.stem.isdecimal()}
    count = max(there, default=0) + 1
    if missing := sorted(set(range(count)) - there) if there else []:
        raise RecordingError(
            f"{directory / f'{missing[0]}.csv'}: missing, though {count - 1}.csv is there: a recording holds a file "
            "<index>.csv for each robot, from 0.csv"
        )
    found = [read_recording(directory, index) for index in range(count)]
    farthest = max(row.distance for recording in found for row in recording.rows)
    if 0.0 < farthest < SHORT_M:
        raise RecordingError(
            f"{directory}: no distance is above {farthest * _CM:.3g} cm: the lengths are not in cm; multiply lengths "
            "in m by 100 (costs by 1e8)"
        )
    for index, one in enumerate(found):
        made_up = len(set(one.estimates)) == 1  # by hand, without estimates: two robots may be told the same
        for other in () if made_up else found[:index]:
            if (one.rows, one.estimates) == (other.rows, other.estimates):
                raise RecordingError(
                    f"{one.path}:1: the measurements and estimates of {other.path.name}: it is a copy; put there the "
                    "robot's own file"
                )
        _once(one, max((other.steps for other in found if other is not one), default=one.steps))
    return found


def _once(recording: ThesisRecording, steps: int) -> None:
    """Raise `RecordingError` where rows are there again that make a file longer than the others, which have `steps`."""
    first: dict[object, int] = {}
    again: list[tuple[int, int]] = []
    for row in zip(recording.times, recording.rows, recording.estimates[1:], recording.lines, strict=True):
        before = first.setdefault(row[:3], row[3])
        if before != row[3]:
            again.append((before, row[3]))
    # Without latency a swarm that has settled does equal iterations at one time; then every file has as many.
    if 0 < len(again) <= recording.steps - steps:
        raise RecordingError(
            f"{recording.path}:{again[0][1]}: the state of line {again[0][0]} once more, and {recording.steps} "
            f"iterations where the other files have {steps}: rows were repeated, take them away"
        )


def mismatches(recordings: Sequence[ThesisRecording]) -> list[str]:
    """Return what files that can be read say of each other, with line and likely reason: they are not of one run, or
    not whole."""
    found = []
    paces = [_pace(one) for one in recordings]
    usual = median_low(paces)
    for one, pace in zip(recordings, paces, strict=True):
        if pace > SLOWEST_S or (usual and not usual / ODD_PACE <= pace <= usual * ODD_PACE):
            found.append(
                f"{one.path}:{one.lines[0]}: from here on an iteration takes {pace:.3g} s, the median of all files is "
                f"{usual:.3g} s: likely its times are in another unit, expected s"
            )
            continue
        longest, later = _later(one, recordings)
        theirs, own = ([each.began + t for t in each.times] for each in (longest, one))
        between = [bisect_left(theirs, after) - bisect_right(theirs, before) for before, after in pairwise(own)]
        most = max(between, default=0)
        lost = longest.steps - one.steps - later
        if min(lost, most) > 1:  # clocks differ and robots take turns: one more or less says nothing
            found.append(
                f"{one.path}:{one.lines[between.index(most) + 1]}: {longest.path.name} has {most} iterations between "
                f"this line and the one before it, and {lost} more in all: likely rows are missing, or the robot was "
                "away; from here on it is fed with measurements of later iterations"
            )
    return found


def early_ends(recordings: Sequence[ThesisRecording]) -> list[str]:
    """Return in words which files end well before the longest one; in lockstep robots are fewer iterations apart than
    they are many."""
    return [
        f"{one.path}: it ends with iteration {one.steps}, in line {one.lines[-1]}; {longest.path.name} has {later} "
        "later ones"
        for one in recordings
        for longest, later in (_later(one, recordings),)
        if later >= len(recordings)
    ]


def _pace(recording: ThesisRecording) -> float:
    """Return how long an iteration takes, s: of two at a time, since one robot's may come in pairs."""
    apart = [after - before for before, after in zip(recording.times, recording.times[2:], strict=False)]
    return median(apart) / 2 if apart else 0.0


def _later(one: ThesisRecording, recordings: Sequence[ThesisRecording]) -> tuple[ThesisRecording, int]:
    """Return the longest recording, and how many iterations it has after the end of this one."""
    longest = max(recordings, key=lambda each: each.steps)
    return longest, sum(longest.began + t > one.began + one.times[-1] for t in longest.times)


def read_recording(directory: Path, index: int) -> ThesisRecording:
    """Return the recording of the robot that is number `index` in the config.

    Raises `RecordingError`, with file and line, for anything that is not as described above.
    """
    if not directory.is_dir():
        raise RecordingError(f"{directory}: there is no such folder of recordings")
    path = directory / f"{index}.csv"
    if path.exists() and not path.is_file():
        raise RecordingError(f"{path}: cannot be read: it is no file")  # a pipe would be waited for without an end
    try:
        lines = path.read_text("ascii", "replace").splitlines()
    except FileNotFoundError:
        raise RecordingError(
            f"{path}: missing; a recording holds a file <index>.csv for each robot, from 0.csv"
        ) from None
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read: {error.strerror}") from None
    if lines and lines[0].startswith(_MARK):
        raise RecordingError(f"{path}:1: it begins with a byte-order mark: save it as UTF-8 or ASCII without one")
    rows: list[ThesisRow] = []
    numbers: list[int] = []
    times: list[float] = []
    start: float | None = None
    before = ""
    previous: list[float] = []
    unsent = 0
    estimates: list[tuple[float, float]] = []
    for number, line in enumerate(lines, 1):
        try:
            values = _numbers(line)
            expect(values[0] <= LATEST_S, f"a time of {values[0]:g} s since 1970: divide times in ms by 1000")
            if before:
                last = previous[0]
                expect(line != before, "the same line as the one before: rows were repeated, take one away")
                expect(
                    values[0] >= last,
                    f"its time is {last - values[0]:.6g} s before the line before: rows are shuffled, sort by time",
                )
            sent = len(values) > 7 and values[7] == 1
            if sent and not unsent and values[1:7] + values[8:] != previous[1:7] + previous[8:]:
                unsent = number
            before, previous = line, values
            if start is None:
                expect(len(values) == 7, f"{len(values)} columns, the first line has 7 (t,x,y,zx,zy,gx,gy)")
                start = values[0]
                estimates.append((values[1] / _CM, values[2] / _CM))
                continue
            expect(len(values) in (8, 12), f"{len(values)} columns, expected 12 (8 in line 2)")
            flag = values[7]
            expect(flag in (0, 1), f"column 8 is {flag:g}, expected the flag 0 or 1")
            if flag == 0:
                expect(
                    len(values) == 12,
                    "a new state without cost, distance and own place: expected 12 columns where column 8 is 0",
                )
                expect(values[9] >= 0, f"a distance of {values[9]:g} cm, expected 0 or more in column 10")
                far = max(abs(value) for value in (*values[1:3], *values[9:12]))
                expect(far <= FARTHEST_CM, f"a length of {far:g} cm: expected at most {FARTHEST_CM:g}")
                _fits(values)
                rows.append(ThesisRow(values[9] / _CM, values[10] / _CM, values[11] / _CM))
                numbers.append(number)
                times.append(values[0] - start)
                estimates.append((values[1] / _CM, values[2] / _CM))
        except ValueError as error:
            raise RecordingError(f"{path}:{number}: {error}") from None
    if not rows:
        raise RecordingError(
            f"{path}:{len(lines) + 1}: the file ends before the first measurement: expected a first line of 7 columns, "
            "then rows of 12 (8 in line 2)"
        )
    if unsent:
        raise RecordingError(
            f"{path}:{unsent}: marked as sent by the 1 in column 8, but not the state of the line before: rows are "
            "shuffled or changed"
        )
    return ThesisRecording(path, tuple(rows), tuple(times), tuple(estimates), start or 0.0, tuple(numbers))


def cost(distance: float, x: float, y: float, own_x: float, own_y: float) -> float:
    """Return column 9 of a new state's line, (phi^2 - |x - p|^2)^2, in the fourth power of the lengths' unit."""
    return (distance**2 - (x - own_x) ** 2 - (y - own_y) ** 2) ** 2


def _fits(values: list[float]) -> None:
    """Raise `ValueError` where the cost of a new state's line is not that of its lengths."""
    x, y, told, distance, own_x, own_y = values[1], values[2], *values[8:12]
    found = cost(distance, x, y, own_x, own_y)
    slack = COST_SHARE * (distance**2 + (x - own_x) ** 2 + (y - own_y) ** 2)
    expect(
        told >= 0 and abs(math.sqrt(told) - math.sqrt(found)) <= slack,
        f"a cost of {told:.6g} in column 9, the line's lengths give {found:.6g}: distances, places or estimates were "
        "changed, or are in different units",
    )


def _numbers(line: str) -> list[float]:
    values = []
    for column, text in enumerate(line.split(","), 1):
        value = finite(text)
        if value is None:
            raise ValueError(f"column {column} is {text[:40]!r}, expected a number")
        expect(abs(value) <= LARGEST, f"column {column} is {value:g}, no number here is above {LARGEST:g}")
        values.append(value)
    return values


def finite(text: str) -> float | None:
    """Return the finite number that a cell holds; None where it holds none. Python's 1_000 is no number in a file."""
    try:
        value = float(text)
    except ValueError:
        return None
    return value if math.isfinite(value) and "_" not in text else None


def expect(right: bool, message: str) -> None:
    """Raise `ValueError` where a line of a file is not `right`."""
    if not right:
        raise ValueError(message)
