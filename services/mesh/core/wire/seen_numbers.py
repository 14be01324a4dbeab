"""Which numbers of a sender were seen: the highest, and one bit for each of those just below it."""


class SeenNumbers:
    """Sequence numbers from 1 up, in any order, in constant memory: what is too old to tell counts as seen."""

    __slots__ = ("_bits", "highest", "size")

    def __init__(self, size: int) -> None:
        self.size = size
        self.highest = 0
        self._bits = 0

    def add(self, number: int) -> bool:
        """Note a number; whether it is new."""
        ahead = number - self.highest
        if ahead > 0:
            self._bits = (self._bits << ahead | 1) & (1 << self.size) - 1 if ahead < self.size else 1
            self.highest = number
            return True
        # A peer chooses the number. The size is checked before the shift, which could make an integer of 512 MiB.
        if -ahead >= self.size or self._bits >> -ahead & 1:
            return False
        self._bits |= 1 << -ahead
        return True

    def has(self, number: int) -> bool:
        """Whether a number counts as seen."""
        behind = self.highest - number
        return behind >= self.size or (behind >= 0 and self._bits >> behind & 1 == 1)
