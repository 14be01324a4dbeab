"""The DWM1001's shell mode, for people and for the calibration laptop: lines of text at the same 115200 baud.

Two carriage returns within a second enter it (`ENTER`), `quit` leaves it. `les`, `lec` and `lep` switch lines at the
update rate on and off:

    les   022E[7.94,8.03,0.00]=3.38 D001[0.00,0.00,0.00]=1.20 le_us=3082 est[6.97,5.17,-1.77,53]
    lec   DIST,2,AN0,022E,7.94,8.03,0.00,3.44,AN1,D001,0.00,0.00,0.00,1.21,POS,6.95,5.37,-1.97,52
    lep   POS,7.10,5.24,-2.03,53

in m, the last number being the quality; without a fix there is no est and no POS. `si` tells the module's state in
lines of the system's log. At high rates the module mixes lines up, so each is held against its form as a whole. There
is no binary traffic in this mode: what a robot's service sends is taken for typing.
"""

import math
import re
from collections import deque

from services.dwm.core.module.tlv import AnchorRange, Location, Position
from swarm.errors import FrameError
from swarm.frozen import frozen

ENTER = b"\r\r"
LEAVE = b"quit\r"
LEAVE_TIMES = 2
"""Binary requests that it took for typing stand before the first one, which is an unknown command then."""
PROMPT = b"dwm>"

MAX_LINE = 1024
"""Bytes: the longest true line, of 15 anchors, has 600."""

RANGE_QUALITY = 100
"""The shell does not tell the quality of a range; it leaves out those that failed."""

_NUMBER = r"(-?\d{1,5}\.\d{2})"
_LES_RANGE = re.compile(rf"([0-9A-F]{{4}})\[{_NUMBER},{_NUMBER},{_NUMBER}\]={_NUMBER}")
_LES = re.compile(
    rf"(?P<ranges>(?:{_LES_RANGE.pattern} ?)*)(?:le_us=\d+ ?)?"
    rf"(?:est\[(?P<x>-?\d{{1,5}}\.\d{{2}}),(?P<y>-?\d{{1,5}}\.\d{{2}}),(?P<z>-?\d{{1,5}}\.\d{{2}}),(?P<q>\d{{1,3}})\])?"
)
_LEC_RANGE = re.compile(rf"AN(\d{{1,2}}),([0-9A-F]{{4}}),{_NUMBER},{_NUMBER},{_NUMBER},{_NUMBER}")
_LEC = re.compile(rf"DIST,(?P<count>\d{{1,2}})(?P<ranges>(?:,{_LEC_RANGE.pattern})*)(?:,(?P<place>POS,.*))?")
_LEP = re.compile(rf"POS,{_NUMBER},{_NUMBER},{_NUMBER},(\d{{1,3}})")
_LOG = re.compile(r"\[(\d{6}\.\d{3}) (INF|WRN|ERR)\] ?(\w+): (.*)")
_ENTRY = re.compile(r"(\w+)=(\S+)")


@frozen
class ShellInfo:
    """One line of `si`: `[000541.880 INF] uwb0: panid=xFD5C addr=xDECA9AABC0A2591A`."""

    uptime: float
    """s."""
    topic: str
    """sys, uwb0, mode, uwbmac, cfg, enc or ble."""
    text: str
    entries: dict[str, str]
    """What it says as name=value."""


Line = Location | Position | ShellInfo


class ShellReader:
    """Takes the module's text apart, in pieces of any size. What is no data (prompt, echo, banner) is passed over.

    `prompts` counts what tells that the module is in shell mode indeed.
    """

    def __init__(self) -> None:
        self.prompts = 0
        self._lines: deque[bytes] = deque()
        self._rest = b""
        self._overlong = False

    def receive(self, data: bytes) -> None:
        """Take bytes as they came; then call `next` until it gives None."""
        *lines, self._rest = re.split(rb"[\r\n]+", self._rest + data)
        if lines and self._overlong:
            lines, self._overlong = lines[1:], False
        self._lines += lines
        self._overlong = self._overlong or len(self._rest) > MAX_LINE
        if self._overlong:
            self._rest = b""
        elif self._rest.strip() == PROMPT:  # it stands without an end of line until something is typed
            self._lines.append(self._rest)
            self._rest = b""

    def next(self) -> Line | None:
        """The next line of data, None where there is none yet.

        Raises `FrameError` for one that starts like data and is garbled; it has been dropped, call again.
        """
        while self._lines:
            raw = self._lines.popleft()
            while (at := raw.rfind(PROMPT)) >= 0:
                self.prompts += 1
                raw = raw[:at] + raw[at + len(PROMPT) :]
            line = _read(raw.decode("ascii", "replace").strip())
            if line is not None:
                return line
        return None


def _read(text: str) -> Line | None:
    if text.startswith("POS,"):
        return _lep(text)
    if text.startswith("DIST,"):
        return _lec(text)
    if re.match(r"[0-9A-F]{4}\[|le_us=|est\[", text):
        return _les(text)
    if found := _LOG.fullmatch(text):
        time, _, topic, rest = found.groups()
        return ShellInfo(float(time), topic, rest, dict(_ENTRY.findall(rest)))
    return None


def _les(text: str) -> Location:
    found = _LES.fullmatch(text)
    if found is None:
        raise _garbled(text)
    ranges = (_range(*fields) for fields in _LES_RANGE.findall(found["ranges"]))
    place = _NO_FIX if found["x"] is None else _place(*(found[name] for name in "xyzq"))
    return Location(place, tuple(ranges))


def _lec(text: str) -> Location:
    found = _LEC.fullmatch(text)
    if found is None:
        raise _garbled(text)
    ranges = [_range(*fields) for _, *fields in _LEC_RANGE.findall(found["ranges"])]
    if len(ranges) != int(found["count"]):
        raise _garbled(text)
    return Location(_NO_FIX if found["place"] is None else _lep(found["place"]), tuple(ranges))


def _lep(text: str) -> Position:
    found = _LEP.fullmatch(text)
    if found is None:
        raise _garbled(text)
    return _place(*found.groups())


_NO_FIX = Position(0.0, 0.0, 0.0, 0)


def _place(x: str, y: str, z: str, quality: str) -> Position:
    if int(quality) > 100:
        raise FrameError(f"shell: position quality of {quality} %")
    return Position(float(x), float(y), float(z), int(quality))


def _range(anchor: str, x: str, y: str, z: str, distance: str) -> AnchorRange:
    if float(distance) < 0:
        raise FrameError(f"shell: distance of {distance} m")
    return AnchorRange(anchor, float(distance), RANGE_QUALITY, Position(float(x), float(y), float(z), 100))


def _garbled(text: str) -> FrameError:
    return FrameError(f"shell: garbled line {text[:60]!r}")


def les(location: Location) -> str:
    """A line as `les` prints it."""
    place = location.position
    words = [f"{r.anchor}[{_xyz(r.position)}]={r.distance:.2f}" for r in location.ranges] + ["le_us=3082"]
    return " ".join([*words, f"est[{_xyz(place)},{place.quality}]"] if place.quality else words)


def lec(location: Location) -> str:
    """A line as `lec` prints it."""
    place = location.position
    words = [f"AN{i},{r.anchor},{_xyz(r.position)},{r.distance:.2f}" for i, r in enumerate(location.ranges)]
    return ",".join(["DIST", str(len(words)), *words, *([lep(place)] if place.quality else [])])


def lep(place: Position) -> str:
    """A line as `lep` prints it."""
    return f"POS,{_xyz(place)},{place.quality}"


def _xyz(place: Position) -> str:
    return ",".join(f"{0.0 if math.isclose(v, 0.0, abs_tol=0.005) else v:.2f}" for v in (place.x, place.y, place.z))
