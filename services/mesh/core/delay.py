"""The radio of a simulated link, receiving side: bytes wait here as long as they would be on the air.

A chunk that was sent at `stamp` is on the air when the bytes before it have passed (bandwidth), arrives after
the latency, and never before the chunk sent earlier: a link keeps its order.
"""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, fields

from swarm.errors import ConfigError

FLOOR = 0.012
"""Shortest one-way time with jitter, s: what the thesis' Bluetooth links never went below."""


@dataclass(frozen=True)
class AirModel:
    """What all links of a simulation are like."""

    latency: float = 0.0
    """One way, s."""
    jitter: float = 0.0
    """Standard deviation of the latency, s."""
    bandwidth: float | None = None
    """bytes/s in each direction; None = without limit."""
    seed: int = 0
    dial: float = 0.0
    """s until a connection is there, or found impossible: finding the other one takes a radio its time."""

    @property
    def shortest(self) -> float:
        """No byte is on the air for less, s."""
        return min(FLOOR, self.latency) if self.jitter else self.latency

    @classmethod
    def parse(cls, text: str) -> "AirModel":
        """Read `latency=0.03,jitter=0.01,bandwidth=78000,seed=1,dial=2`, each part optional."""
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
        return cls(
            values.get("latency", 0.0),
            values.get("jitter", 0.0),
            values.get("bandwidth"),
            int(values.get("seed", 0)),
            values.get("dial", 0.0),
        )


class DelayLine:
    """One direction of one link."""

    def __init__(self, model: AirModel, gauss: Callable[[float, float], float]) -> None:
        """`gauss(mean, deviation)` draws from a generator seeded for this direction of this link."""
        self._model = model
        self._gauss = gauss
        self._chunks: deque[tuple[float, bytes]] = deque()
        self._last_arrival = 0.0
        self.free_at = 0.0
        """When the last chunk taken in has left the sender. Until then the sender's queue, not this line,
        holds what comes next: take nothing in, so that the sender feels the link's bandwidth."""

    def push(self, data: bytes, stamp: float) -> float:
        """Take in a chunk that was sent at `stamp`; b"" stands for the end of the stream. Returns when it arrives."""
        arrival = self.arrival(len(data), stamp)
        self._chunks.append((arrival, data))
        return arrival

    def arrival(self, size: int, stamp: float) -> float:
        """When so many bytes arrive that were sent at `stamp`: after all that was sent before."""
        model = self._model
        self.free_at = max(self.free_at, stamp)
        if model.bandwidth is not None:
            self.free_at += size / model.bandwidth
        delay = model.latency
        if model.jitter:
            delay = max(self._gauss(delay, model.jitter), model.shortest)
        return self.hold(max(self._last_arrival, self.free_at + delay))

    def hold(self, arrival: float) -> float:
        """Nothing sent later arrives before this time."""
        self._last_arrival = arrival
        return arrival

    def next_arrival(self) -> float | None:
        """When the oldest chunk on the air arrives."""
        return self._chunks[0][0] if self._chunks else None

    def pop(self) -> bytes:
        """The oldest chunk."""
        return self._chunks.popleft()[1]
