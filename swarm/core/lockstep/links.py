"""The neighbours whose link carries nothing: the lockstep reaches them around that link."""

SILENT_AFTER_RTTS = 1.5
SILENT_AFTER = 0.1
"""A neighbour that has not answered a question after so many round-trip times, and s, is talked to around its link.
Whoever hears us answers at once; what jitter and a loaded robot add to a round trip is within this."""

_NEVER = float("inf")


class SilentLinks:
    """Learns from questions and from what comes over links; whatever comes over one ends its silence."""

    def __init__(self) -> None:
        self._asked: tuple[str, ...] = ()
        """The peers that were asked, and have said nothing over their link since."""
        self.due = _NEVER
        """The time at which `silent` is to be called."""
        self.around: tuple[str, ...] = ()
        """Neighbours to be talked to around their links."""

    @property
    def matter(self) -> bool:
        """Whether it matters who speaks."""
        return bool(self._asked or self.around)

    def asked(self, peers: tuple[str, ...], rtt: float, now: float, *, least: float) -> None:
        """Note that a question went out over the links with `peers`. Before the time `least` no link counts as
        silent."""
        self._asked = peers
        self.due = max(now + max(SILENT_AFTER_RTTS * rtt, SILENT_AFTER), least)

    def progress(self) -> None:
        """Forget the question: its answer is there, or its time is over."""
        self._asked, self.due = (), _NEVER

    def speaks(self, peer: str) -> None:
        """Something came over the link with `peer`."""
        self._asked = tuple([name for name in self._asked if name != peer])
        self.around = tuple([name for name in self.around if name != peer])

    def silent(self) -> tuple[str, ...]:
        """Return the peers whose links turn out to be silent; to be called at `due`."""
        new = tuple([name for name in self._asked if name not in self.around])
        self.progress()
        return new

    def go_around(self, peer: str) -> bool:
        """Talk to `peer` around its link from now on; whether that is new."""
        new = peer not in self.around
        if new:
            self.around = (*self.around, peer)
        return new
