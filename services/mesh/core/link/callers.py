"""Who may begin a handshake with us: strangers share a small house, and cannot keep neighbours out of it.

What a stranger can cost us is bounded before we believe a word of it: `MAX_HALF_OPEN` handshakes at once for all of
them and `MAX_PER_SOURCE` for one address, and an address whose handshakes we refuse is shut out for a while. An
address of a neighbour has room of its own, which nobody else's calls take, and is never shut out: a neighbour that
was set up wrongly dials with a back-off of its own, and who forges its address must not be able to lock it out.
"""

from collections import OrderedDict
from collections.abc import Iterable

from swarm.frozen import frozen

MAX_HALF_OPEN = 16
"""Handshakes of strangers, and of callers without a known address, at the same time."""

MAX_PER_SOURCE = 8
"""Handshakes of one address at the same time."""

FIRST_SHUT_OUT = 0.2
"""s that an address is shut out after a refused handshake; doubles with each further one."""

LONGEST_SHUT_OUT = 5.0
"""s; as long as our own robots wait at most until they call again."""

_MAX_REMEMBERED = 256
"""Addresses whose refusals are remembered; the longest unheard of goes first."""


@frozen
class Caller:
    """What the transport knows of who calls, before a byte was exchanged."""

    source: str = ""
    """The address; empty where the transport has none."""
    robot: str | None = None
    """The robot that the address belongs to. None = the transport cannot tell, "" = it can, and no robot has it."""
    reserved: bool = False
    """Whether neighbours may call from this address (a known robot's address needs no saying)."""

    @property
    def has_own_room(self) -> bool:
        """Whether its handshakes do not count among the strangers'."""
        return self.reserved or bool(self.robot)


UNKNOWN = Caller()
"""A caller of whom the transport knows nothing."""


class Callers:
    """Remembers whom we refused."""

    def __init__(self) -> None:
        self._refused: OrderedDict[str, tuple[int, float]] = OrderedDict()

    def refusal(self, caller: Caller, half_open: Iterable[Caller], now: float) -> tuple[str, str, str] | None:
        """Why a caller may not begin its handshake: counter, problem and text; None where it may."""
        if caller.robot == "":
            text = f"connection refused: {caller.source} is the address of no robot of ours"
            return "refused_robot", "strange address", text
        if self.has_room(caller, half_open, now):
            return None
        limit = f"more than {MAX_HALF_OPEN} wait for their handshake, or the last ones from there were refused"
        text = f"connection refused source={caller.source or 'unknown'}: {limit}"
        return "half_open", "half-open connections", text

    def has_room(self, caller: Caller, half_open: Iterable[Caller], now: float) -> bool:
        """Whether a caller may begin its handshake while those of `half_open` are in theirs."""
        if now < self._refused.get(caller.source, (0, 0.0))[1]:
            return False
        same = strangers = 0
        for other in half_open:
            same += caller.source == other.source != ""
            strangers += not other.has_own_room
        return same < MAX_PER_SOURCE and (caller.has_own_room or strangers < MAX_HALF_OPEN)

    def refused(self, caller: Caller, now: float) -> None:
        """A handshake of this caller was refused."""
        if caller.has_own_room or not caller.source:
            return
        count, _ = self._refused.pop(caller.source, (0, 0.0))
        self._refused[caller.source] = count + 1, now + min(LONGEST_SHUT_OUT, FIRST_SHUT_OUT * 2.0 ** min(count, 16))
        if len(self._refused) > _MAX_REMEMBERED:
            self._refused.popitem(last=False)

    def confirmed(self, caller: Caller) -> None:
        """A caller has shown to be one of us: what was held against its address is forgotten."""
        self._refused.pop(caller.source, None)
