"""What a robot still lacks of one large message: which pieces to ask for next, and which are lost."""

from collections import OrderedDict, deque

from services.mesh.core.bulk.pieces import SIZE, Id, count_of
from swarm.errors import FrameError

REORDERED = 3
"""Pieces asked for later that may come before one until that is taken for lost."""


class Fetch:
    """One message on its way here, from one robot at a time."""

    __slots__ = ("_again", "_asked", "_next", "_parts", "_repeated", "_serial", "began", "count", "have", "heard", "id",
                 "source", "sources", "total")  # fmt: skip

    def __init__(self, id: Id, total: int, now: float) -> None:
        self.id = id
        self.total = total
        self.count = count_of(total)
        self.have = 0
        """Pieces that are there."""
        self.began = now
        self.heard = now
        """When the last new piece came."""
        self.source: str | None = None
        """Who is asked now."""
        self.sources: deque[str] = deque()
        """Who else may have it."""
        self._parts: dict[int, bytes] = {}
        self._next = 0
        self._again: deque[int] = deque()
        self._asked: OrderedDict[int, tuple[float, int]] = OrderedDict()
        self._repeated: set[int] = set()
        self._serial = 0

    @property
    def asked(self) -> int:
        """Pieces asked for that have not come."""
        return len(self._asked)

    @property
    def asked_since(self) -> float:
        """When the oldest of them was asked for."""
        return next(iter(self._asked.values()))[0] if self._asked else float("inf")

    def pick(self, now: float) -> int | None:
        """The next piece to ask for, noted as asked for; None where all are."""
        while self._again:
            index = self._again.popleft()
            if index not in self._parts:
                break
        else:
            if self._next >= self.count:
                return None
            index = self._next
            self._next += 1
        self._serial += 1
        self._asked[index] = (now, self._serial)
        return index

    def take(self, index: int, data: bytes, now: float) -> tuple[float, int] | None:
        """A piece came: s since it was asked for (0 where it was more than once, and nobody knows which time led to
        it), and how many others it shows to be lost. None where it is not new, or was not asked for. Raises
        `FrameError`."""
        if index >= self.count or len(data) != min(SIZE, self.total - index * SIZE):
            raise FrameError(f"PIECE {index} of {len(data)} bytes: not one of {self.total} bytes in all")
        if index in self._parts:
            return None
        asked = self._asked.pop(index, None)
        if asked is None and index not in self._again:
            return None
        self._parts[index] = data
        self.have += 1
        self.heard = now
        if asked is None:
            return 0.0, 0  # taken for lost, and here after all
        lost = [each for each, (_, serial) in self._asked.items() if serial + REORDERED < asked[1]]
        for each in lost:
            del self._asked[each]
        self._again += lost
        self._repeated.update(lost)
        return 0.0 if index in self._repeated else now - asked[0], len(lost)

    def ask_again(self) -> None:
        """What was asked for is not to be expected any more."""
        self._again.extendleft(reversed(self._asked))
        self._repeated.update(self._asked)
        self._asked.clear()

    def piece(self, index: int) -> bytes | None:
        """A piece that is there."""
        return self._parts.get(index)

    @property
    def complete(self) -> bool:
        """Whether all are."""
        return self.have == self.count

    def payload(self) -> bytes:
        """The whole message."""
        return b"".join(self._parts[index] for index in range(self.count))
