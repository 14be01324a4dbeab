"""A simulated DWM1001 with PANS R2 as its serial line shows it: generic mode, shell mode, settings, update rates.

Bytes in, bytes out, with the times a real one takes: a request ends at a gap of 763 us, an answer comes after 10 to
30 ms at 115200 baud, `reset` takes a second. What it measures is not its own affair (`uwb`): `measure` is called when
it is due. No IO: whoever owns the line feeds `receive`, calls `handle_timer` at `next_deadline` and sends `to_send`.
"""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace

from services.dwm.core.module import calls
from services.dwm.core.module.calls import UWB_ACTIVE, Settings, UpdateRate, Version
from services.dwm.core.module.tlv import (
    LOC_GET,
    NOWHERE,
    OK,
    POSITION,
    AnchorRange,
    Location,
    Position,
    decode_position,
    encode_location,
    encode_part,
    encode_position,
    encode_refusal,
)
from swarm.core.random_numbers import RandomNumbers
from swarm.errors import FrameError

REQUEST_GAP = 25 / 32768
"""Seconds of silence that end a request, whole or not (API guide 4.3)."""

LATENCY = (0.010, 0.030)
"""Seconds from request to answer, uniform between these."""

BYTE = 10 / 115200
"""Seconds that a byte takes on the line."""

RESTART = 1.0
"""Seconds that `reset` takes."""

JOINING = 0.5
"""Seconds from the end of a restart until the module belongs to its network."""

STILL_AFTER = 2.0
"""Seconds without motion until the accelerometer says that it stands still [estimated]."""

ENTER_WITHIN = 1.0
"""Seconds between the two carriage returns that enter the shell."""

MAX_LINE = 1024
"""Bytes that its shell takes without an end of line."""

UNKNOWN_CALL, BAD_PARAMETER = 1, 3

VERSION = Version((1, 3, 0, 1), 0x00010700, 0xDECA002A)
READY_RATE = UpdateRate(1, 1)
"""The rates that `swarm dwm configure` sets."""

BANNER = "\r\n\r\n DWM1001 TWR Real Time Location System (simulated)\r\n\r\n Help      :  ? or help\r\n\r\ndwm> "


@dataclass
class Flash:
    """The settings that outlast a reset."""

    settings: Settings
    rate: UpdateRate = READY_RATE
    place: Position = NOWHERE
    """The place of an anchor."""


class Dwm1001:
    """One module. Its `settings` are those in force."""

    def __init__(
        self,
        identity: int,
        flash: Flash,
        generator: RandomNumbers,
        measure: Callable[[], Location],
        now: float,
        *,
        chunk: int = 255,
    ) -> None:
        """`identity`: the 64-bit id; `generator` decides the latencies. `chunk` bytes leave together: on a real line
        one by one, but each would wake two processes; so a whole answer comes when its last byte would."""
        self.identity = identity
        self.flash = flash
        self.settings = flash.settings
        self.survey: tuple[AnchorRange, ...] = ()
        """Ranges to other anchors, once the phone app had them measured."""
        self.in_shell = False
        self._generator = generator
        self._chunk = chunk
        self._measure = measure
        self._location = Location(NOWHERE, ())
        self._located = False
        self._moved = self._measured = now
        self._measured = now - generator.uniform(0.0, self._period())
        self._away_until = now
        self._joined_at = now
        self._request = bytearray()
        self._request_by = 0.0
        self._returns: list[float] = []
        self._line = bytearray()
        self._out: deque[tuple[float, bytes]] = deque()

    @property
    def address(self) -> str:
        """Return the short address."""
        return f"{self.identity & 0xFFFF:04X}"

    def is_ranged(self, now: float) -> bool:
        """Return whether tags get a range to it."""
        return self.settings.anchor and self.settings.uwb == UWB_ACTIVE and now >= self._away_until

    def moved(self, now: float) -> None:
        """Note that its accelerometer feels a motion."""
        self._moved = now

    def next_deadline(self) -> float:
        """Return the time at which to call `handle_timer` or `to_send` next."""
        deadline = self._measured + self._period() if self._ranges() else float("inf")
        if self._request:
            deadline = min(deadline, self._request_by)
        return min(deadline, self._out[0][0]) if self._out else deadline

    def handle_timer(self, now: float) -> None:
        """Measure when it is time to; end a request that a gap has ended."""
        if self._request and now >= self._request_by:
            self._end_request(now)
        if self._ranges() and now >= self._measured + self._period():
            self._measured += self._period()
            if self._measured + self._period() <= now:  # we were late: measurements do not queue up
                self._measured = now
            if now >= self._joined_at:
                self._location, self._located = self._measure(), True

    def receive(self, data: bytes, now: float) -> None:
        """Take bytes from the line."""
        if now < self._away_until:
            return
        if self.in_shell:
            self._type(data, now)
            return
        if self._request and now >= self._request_by:
            self._end_request(now)
        self._request += data
        self._request_by = now + REQUEST_GAP
        while not self.in_shell and len(self._request) >= 2 and len(self._request) >= (end := 2 + self._request[1]):
            request = bytes(self._request[:end])
            del self._request[:end]
            self._answer(self._call(request, now), now)

    def to_send(self, now: float) -> bytes:
        """Return the bytes that have left the module by now."""
        data = bytearray()
        while self._out and now >= self._out[0][0]:
            data += self._out.popleft()[1]
        return bytes(data)

    # -- generic mode ------------------------------------------------------------------------------------------

    def _end_request(self, now: float) -> None:
        request = bytes(self._request)
        self._request.clear()
        if request.strip(b"\r"):
            self._returns.clear()
        else:
            self._returns = [at for at in self._returns if now - at <= ENTER_WITHIN] + [now] * len(request)
            if len(self._returns) >= 2:
                self._returns.clear()
                self.in_shell = True
                self._say(BANNER, now)
                return
        self._answer(encode_refusal(UNKNOWN_CALL), now)

    def _call(self, request: bytes, now: float) -> bytes:
        """Return the answer to one whole request."""
        try:
            call = calls.call_of(request)
        except FrameError:
            return encode_refusal(UNKNOWN_CALL)
        done = encode_refusal(OK)
        kind, value = request[0], request[2:]
        if call is LOC_GET:
            self._located = False
            return encode_location(self._seen(), anchor=self.settings.anchor)
        if call is calls.POS_GET:
            return done + encode_part(POSITION, encode_position(self._seen().position))
        if call is calls.CFG_GET:
            return done + encode_part(calls.CONFIG, calls.encode_settings(self.settings))
        if call is calls.UPD_RATE_GET:
            return done + calls.encode_rate(self.flash.rate)
        if call is calls.VER_GET:
            return done + calls.encode_version(VERSION)
        if call is calls.NODE_ID_GET:
            return done + encode_part(calls.NODE_ID, self.identity.to_bytes(8, "little"))
        if call is calls.STATUS_GET:
            return done + encode_part(calls.STATUS, bytes((self._located | (now >= self._joined_at) << 1, 0)))
        if call is calls.RESET:
            self._restart(now)
            return done
        return encode_refusal(OK if self._set(kind, value) else BAD_PARAMETER)

    def _set(self, kind: int, value: bytes) -> bool:
        if kind == calls.POS_SET:
            try:
                self.flash.place = decode_position(value)
            except FrameError:
                return False
            return True
        if kind == calls.RATE_SET:
            rate = calls.decode_rate(value)
            valid = all(1 <= period <= calls.SLOWEST for period in (rate.moving, rate.still))
            if valid:
                self.flash.rate = rate
            return valid
        settings = (calls.decode_anchor if kind == calls.ANCHOR_SET else calls.decode_tag)(value)
        if settings.uwb > UWB_ACTIVE or settings.measurement:
            return False
        self.flash.settings = settings
        return True

    def _restart(self, now: float) -> None:
        self._away_until = now + RESTART
        self._joined_at = now + RESTART + JOINING
        self.settings = self.flash.settings
        self._location, self._located = Location(NOWHERE, ()), False
        self._measured = self._joined_at
        self.in_shell = False
        self._request.clear()

    def _answer(self, data: bytes, now: float) -> None:
        self._leave(data, now + self._generator.uniform(*LATENCY))

    def _leave(self, data: bytes, at: float) -> None:
        """Put bytes on the line, behind those that are on it."""
        at = max(at, self._out[-1][0] if self._out else at)
        for start in range(0, len(data), self._chunk):
            chunk = data[start : start + self._chunk]
            at += len(chunk) * BYTE
            self._out.append((at, chunk))

    # -- shell mode --------------------------------------------------------------------------------------------

    def _type(self, data: bytes, now: float) -> None:
        for byte in data:
            if byte == ord("\r"):
                text, self._line = self._line.decode("ascii", "replace").strip(), bytearray()
                self._say("\r\n", now)
                if text == "quit":
                    self.in_shell = False
                    return
                self._say("unknown command\r\ndwm> " if text else "dwm> ", now)
            elif len(self._line) < MAX_LINE:
                self._line.append(byte)
                if 0x20 <= byte < 0x7F:
                    self._say(chr(byte), now)

    def _say(self, text: str, now: float) -> None:
        self._leave(text.encode("ascii"), now)

    # -- measuring ---------------------------------------------------------------------------------------------

    def _ranges(self) -> bool:
        return not self.settings.anchor and self.settings.uwb == UWB_ACTIVE

    def _period(self) -> float:
        """Return the seconds from the last measurement to the next. A motion ends a long period."""
        rate = self.flash.rate
        still = self.settings.stationary and self._measured - self._moved >= STILL_AFTER
        return (rate.still if still else rate.moving) * calls.RATE_UNIT

    def _seen(self) -> Location:
        """Return the place and ranges that the module answers."""
        if self.settings.anchor:
            return Location(self.flash.place, self.survey)
        if not self.settings.engine:
            return replace(self._location, position=NOWHERE)
        return self._location
