"""The measurement of the bus' speed: reads from and writes to the ATmega, timed one by one (thesis 2.2.5: 21 and 53
kbit/s).

Read is the beginning of the buffer, written the mailbox's window, which nothing looks at while no request is under way.
"""

from services.balancer.core.devices import balboa
from services.balancer.core.devices.mailbox import TICKET_LIMIT
from services.balancer.core.slack.transfers import read, write
from services.balancer.core.slack.wire_time import WHOLE, Room, Transfer
from swarm.errors import LocalError
from swarm.messages import I2CRates, MeasureI2C

MOST = 1000
"""The most transfers of each kind."""
FAILURES = 20
"""Failed transfers in a row after which a measurement is given up."""
TRANSFER_S = 0.04
"""Seconds for each transfer: four ticks, where the bus has other things to do."""


def longest(count: int) -> float:
    """Return the seconds after which a measurement of `count` transfers of each kind ends with those that there was
    time for."""
    return 2 * count * TRANSFER_S


def check_measurement(request: MeasureI2C) -> None:
    """Raises `LocalError` where that cannot be measured."""
    if not 1 <= request.size <= balboa.WINDOW_SIZE:
        raise LocalError(f"size: {request.size} bytes, expected 1 to {balboa.WINDOW_SIZE}")
    if not 1 <= request.count <= MOST:
        raise LocalError(f"count: {request.count}, expected 1 to {MOST}")
    if len(request.ticket) > TICKET_LIMIT:
        raise LocalError(f"ticket of {len(request.ticket)} characters, at most {TICKET_LIMIT}")


class RateMeter:
    """A slack task; who runs it says with `timed` how long the transfer took, its pause included, before `take`."""

    def __init__(self) -> None:
        self.news: I2CRates | None = None
        """What is to be told; whoever takes it sets None."""
        self._request: MeasureI2C | None = None
        self._seconds: list[list[float]] = [[], []]
        self._writing = False
        self._failures = 0
        self._failed = 0
        self._end_at: float | None = None

    def measure(self, request: MeasureI2C) -> None:
        """Begin with a request that `check_measurement` accepted; one that is under way is given up."""
        self._request, self._seconds, self._writing = request, [[], []], False
        self._failures = self._failed = 0
        self._end_at = None

    def timed(self, seconds: float) -> None:
        """Note the duration of the transfer."""
        self._seconds[self._writing].append(seconds)

    @property
    def active(self) -> bool:
        """Whether a measurement is under way."""
        return self._request is not None

    def give_up(self, now: float, problem: str) -> None:
        """End the measurement under way."""
        self._end(now, problem)

    def next(self, now: float, room: Room = WHOLE) -> Transfer | None:
        del room
        if self._request is None:
            return None
        if self._end_at is None:
            self._end_at = now + longest(self._request.count)
        if now > self._end_at and self._seconds[True]:
            self._end(now, "")
            return None
        size = self._request.size
        return write(balboa.MAILBOX_WINDOW, bytes(size)) if self._writing else read(balboa.VERSION, size)

    def take(self, data: bytes, now: float) -> None:
        del data
        assert self._request is not None
        self._failures = 0
        self._writing = not self._writing
        if len(self._seconds[True]) >= self._request.count:
            self._end(now, "")

    def fail(self, error: OSError, now: float) -> None:
        self._failures += 1
        self._failed += 1
        if self._failures >= FAILURES and self._request is not None:
            self._end(now, f"I2C: {error.strerror or error}")

    def _end(self, now: float, problem: str) -> None:
        request = self._request
        assert request is not None
        reads, writes = ([8 * request.size / each for each in kind] for kind in self._seconds)
        self.news = I2CRates(
            now, request.ticket, request.size, len(writes), self._failed, _rate(reads), _rate(writes), problem
        )
        self._request = None


def _rate(rates: list[float]) -> float | None:
    """bit/s over all transfers together: their times add up."""
    return len(rates) / sum(1 / rate for rate in rates) if rates else None
