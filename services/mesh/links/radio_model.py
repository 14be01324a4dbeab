"""The radio of a simulated link, receiving side: bytes wait here as long as they would be on the air.

A chunk that was sent at `stamp` is on the air when the bytes before it have passed (bandwidth), arrives after
the latency, and never before the chunk sent earlier: a link keeps its order. Nothing is ever missing: a radio packet
that is lost is sent again by the baseband (Bluetooth Core, vol 2 part B, 7.6: ARQ), which shows as delay.
"""

import math
from dataclasses import fields

from swarm.core.random_numbers import RandomNumbers
from swarm.errors import ConfigError
from swarm.frozen import frozen

FLOOR = 0.012
"""Shortest one-way time with jitter, s: what the thesis' Bluetooth links never went below."""

PACKET = 339
"""Bytes of a DH5 packet, the largest of Bluetooth's basic rate. At 78 kB/s they take 4.3 ms; six slots are 3.75 ms."""
AGAIN = 6 * 625e-6
"""Seconds until a lost packet is there: its five slots, and the one in which the receiver says that it lacks it."""
MAX_LOSS = 0.9


@frozen
class AirModel:
    """The properties of all links of a simulation."""

    latency: float = 0.0
    """One way, s."""
    jitter: float = 0.0
    """Standard deviation of the latency, s."""
    bandwidth: float | None = None
    """bytes/s in each direction; None = without limit."""
    seed: int = 0
    dial: float = 0.0
    """Seconds until a connection is there, or found impossible: finding the other one takes a radio its time."""
    loss: float = 0.0
    """Probability that a radio packet is lost, and has to be sent again."""

    @property
    def draws(self) -> bool:
        """Whether its links need random numbers."""
        return self.jitter > 0.0 or self.loss > 0.0

    @property
    def shortest(self) -> float:
        """Return the shortest time of a byte on the air, s."""
        return min(FLOOR, self.latency) if self.jitter else self.latency

    @classmethod
    def parse(cls, text: str) -> "AirModel":
        """Read `latency=0.03,jitter=0.01,bandwidth=78000,seed=1,dial=2,loss=0.05`, each part optional."""
        names = [field.name for field in fields(cls)]
        values: dict[str, float] = {}
        for part in filter(None, text.split(",")):
            name, _, number = part.partition("=")
            try:
                values[name] = float(number)
            except ValueError:
                raise ConfigError(f"SWARM_SIM_LINK: {part!r}: expected {'|'.join(names)}=number") from None
            if name not in names or not 0.0 <= values[name] < float("inf"):
                raise ConfigError(f"SWARM_SIM_LINK: {part!r}: expected {'|'.join(names)}=number, not negative")
        if values.get("bandwidth") == 0.0:
            raise ConfigError("SWARM_SIM_LINK: bandwidth=0: expected bytes per second, or leave it out for no limit")
        if values.get("loss", 0.0) > MAX_LOSS:
            raise ConfigError(f"SWARM_SIM_LINK: loss={values['loss']:g}: expected at most {MAX_LOSS:g}")
        return cls(
            values.get("latency", 0.0),
            values.get("jitter", 0.0),
            values.get("bandwidth"),
            int(values.get("seed", 0)),
            values.get("dial", 0.0),
            values.get("loss", 0.0),
        )


class DelayLine:
    """One direction of one link."""

    def __init__(self, model: AirModel, numbers: RandomNumbers | None) -> None:
        """`numbers` are seeded for this direction of this link; None where the model draws none."""
        self._model = model
        self._numbers = numbers
        self._chunks: list[tuple[float, bytes]] = []  # seldom more than one; an empty deque takes 0.7 kB
        self._last_arrival = 0.0
        self.free_at = 0.0
        """The time at which the last chunk taken in has left the sender. Until then the sender's queue, not this
        line, holds what comes next: take nothing in, so that the sender feels the link's bandwidth."""

    def push(self, data: bytes, stamp: float) -> float:
        """Take in a chunk that was sent at `stamp`; b"" stands for the end of the stream. Returns when it arrives."""
        arrival = self.arrival(len(data), stamp)
        self._chunks.append((arrival, data))
        return arrival

    def arrival(self, size: int, stamp: float) -> float:
        """Return when `size` bytes arrive that were sent at `stamp`: after all that was sent before."""
        model = self._model
        if stamp > self.free_at:
            self.free_at = stamp
        if model.bandwidth is not None:
            self.free_at += size / model.bandwidth
        delay = model.latency
        if self._numbers is not None:
            if model.jitter:
                delay = max(self._numbers.gauss(delay, model.jitter), model.shortest)
            if model.loss:
                again = AGAIN * self._losses(size, self._numbers)
                if model.bandwidth is None:
                    delay += again
                else:
                    self.free_at += again
        arrival = self.free_at + delay
        if arrival > self._last_arrival:
            self._last_arrival = arrival
        return self._last_arrival

    def _losses(self, size: int, numbers: RandomNumbers) -> int:
        """Return how many packets are lost until all of `size` bytes have arrived: for each a geometric
        distribution."""
        scale = 1.0 / math.log(self._model.loss)
        return sum(int(math.log(1.0 - numbers.random()) * scale) for _ in range(max(1, math.ceil(size / PACKET))))

    def hold(self, arrival: float) -> float:
        """Let nothing that is sent later arrive before this time."""
        self._last_arrival = arrival
        return arrival

    def next_arrival(self) -> float | None:
        """Return when the oldest chunk on the air arrives."""
        return self._chunks[0][0] if self._chunks else None

    def pop(self) -> bytes:
        """Take the oldest chunk."""
        return self._chunks.pop(0)[1]
