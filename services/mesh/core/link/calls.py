"""The calls that make links: who calls whom and when, and who may be at the other end.

`Dialler` says when a neighbour is to be dialled, which `dials` gives to one of the two ends. A Bluetooth page keeps the
caller's radio from its links, so a robot that does not answer is called rarely. When it is back and nobody calls it, it
knocks: it calls those who should call it, and they call back at once (`calling`, `Connections`).

`Search` looks for robots by calling those that we would dial and have no link with. Those out of the swarm's reach
(`far`) are called again and again, with a growing pause; those in the swarm whom we have not reached ourselves
(`near`) to learn whether we hear each other, which the automatic topology wants to know. One call at a time: a page
of an absent robot takes a Bluetooth adapter 5 s. (An inquiry takes it 10 s, finds also what is not ours, and needs
PyBluez: that is `swarm discover`.)

`refusal` says what a HELLO must say so that its sender may prove that it holds the key.
"""

from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, field

from services.mesh.core.wire import frames
from services.mesh.core.wire.auth import newest_common
from swarm.config.types import MeshConfig, RobotConfig
from swarm.frozen import frozen

FIRST_DELAY = 0.2
"""Seconds until the second attempt."""

LONGEST_DELAY = 5.0
"""Seconds between attempts at most, where calls keep no radio busy: a robot that returns is met again within this
time, and there is no last attempt."""

EAGER = 3
"""Calls of a target in vain after which `Search` keeps to `OTHERS_SHARE`, where calls are no pages."""

EAGER_S = 15.0
"""Seconds of calls of a robot in vain after which calls keep to `SHARE`: three pages. A call that fails at once keeps
no radio busy: where the own adapter is off for a few seconds, a dozen of them do not make an absent robot of a
neighbour."""

SHARE = 0.05
"""Share of its time that the robot which is to call spends on calls of one that does not answer: on Bluetooth a page of
5 s takes the caller's radio from everybody else."""

OTHERS_SHARE = 0.02
"""Share of its time that all other robots together spend on calls of one that does not answer."""

JITTER = 0.5
"""Fraction by which each delay is drawn longer or shorter, so that robots that lost each other together do not
retry together."""

GOOD_AFTER = 1.0
"""Seconds that a link must have been up for the back-off to start from the beginning again. Without it two processes
of one name, which replace each other's connection, would do so several times a second."""


def dials(me: RobotConfig, peer: RobotConfig) -> bool:
    """Return whether `me` dials `peer`: the lower Bluetooth address does, or the lower name where one has none.

    With both ends dialling, Bluetooth pages collide: both fail after 5 s (measured, docs/reference/network/frames.md).
    """
    if me.bluetooth is not None and peer.bluetooth is not None:
        return _address(me.bluetooth) < _address(peer.bluetooth)
    return me.name < peer.name


def can_link(a: RobotConfig, b: RobotConfig) -> bool:
    """Return whether there can be a link between two robots: the one that is dialled has an address."""
    return has_address(b if dials(a, b) else a)


def has_address(robot: RobotConfig) -> bool:
    """Return whether a robot can be called at all."""
    return robot.link is not None or robot.bluetooth is not None


def _address(text: str) -> bytes:
    return bytes.fromhex(text.replace(":", ""))


class Dialler:
    """The times at which one neighbour is dialled. At most one attempt runs at a time; the first is due at once."""

    def __init__(self, random: Callable[[], float]) -> None:
        """`random` gives uniform numbers from 0 up to 1."""
        self._random = random
        self._failures = 0
        self._in_vain = 0.0
        """Seconds of calls in vain since the last good link."""
        self._next: float | None = 0.0
        self._up_since: float | None = None

    def next_deadline(self) -> float | None:
        """Return the time of the next attempt; None while an attempt or a connection lasts."""
        return self._next

    def take(self, now: float) -> bool:
        """Return whether to dial now; if so, the attempt has begun."""
        if self._next is None or now < self._next:
            return False
        self._next = None
        return True

    def up(self, now: float) -> None:
        """The attempt led to a link."""
        self._up_since = now
        self._next = None

    def ended(self, now: float, page: float = 0.0) -> None:
        """The attempt failed or its link is down: plan the next one. `page`: s for which a call in vain kept the radio
        from other links."""
        if self._up_since is not None and now - self._up_since >= GOOD_AFTER:
            self._failures, self._in_vain = 0, 0.0
        self._up_since = None
        self._in_vain += page
        delay = min(LONGEST_DELAY, FIRST_DELAY * 2.0 ** min(self._failures, 16))
        self._failures += 1
        drawn = self._random()
        rare = page * (1.0 / SHARE - 1.0) * (1.0 + JITTER * drawn) if self._in_vain >= EAGER_S else 0.0
        self._next = now + max(delay * (1.0 - JITTER + 2.0 * JITTER * drawn), rare)

    def hurry(self, now: float) -> None:
        """The neighbour is there after all: dial it soon, unless that is under way."""
        self._failures, self._in_vain = 0, 0.0
        if self._next is not None:
            self._next = min(self._next, now + FIRST_DELAY)


@frozen
class Caller:
    """A caller as the transport knows it before a byte was exchanged."""

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


FIRST_PAUSE = 0.5
"""Seconds within which a new target is called for the first time."""

PAUSE = 1.0
"""Seconds after the first call that failed; doubles with each further one."""

LONGEST_FAR, LONGEST_NEAR = 30.0, 300.0
"""Seconds between two calls at most. Who is in the swarm lacks nothing if we do not hear it."""

_NEVER = float("inf")


@dataclass(eq=False)
class _Target:
    far: bool
    next_at: float
    failures: int = 0


class Search:
    """The calls of one robot."""

    def __init__(self, random: Callable[[], float], callers: int = 0, eager: int = EAGER) -> None:
        """`random` gives numbers from 0 up to 1; `callers`: how many robots may call one target, 0 where that does not
        matter; `eager`: calls of a target in vain after which they keep to `OTHERS_SHARE`."""
        self._random = random
        self._callers = callers
        self._eager = eager
        self._targets: dict[str, _Target] = {}
        self._began = 0.0
        """The time at which the call that is under way began."""
        self.calling: str | None = None
        """The robot that is being called."""

    def aim(self, far: Collection[str], near: Collection[str], now: float) -> None:
        """Replace the targets. A target that is new, or went from near to far, is called soon."""
        for name in self._targets.keys() - set(far) - set(near):
            del self._targets[name]
        for names, is_far in ((far, True), (near, False)):
            for name in names:
                target = self._targets.get(name)
                if target is None or target.far != is_far:
                    self._targets[name] = _Target(is_far, now + FIRST_PAUSE * self._random())

    def take(self, now: float) -> str | None:
        """Return the target to call now, far ones first; None where none is due. Call `ended` afterwards."""
        if self.calling is None:
            due = [
                (not target.far, target.next_at, name)
                for name, target in self._targets.items()
                if now >= target.next_at
            ]
            if due:
                self.calling = min(due)[2]
                self._began = now
                return self.calling
        return None

    def ended(self, name: str, now: float) -> None:
        """Note that a call is over. A robot that is linked now is no target any more; another one is called again
        later."""
        took = 0.0
        if name == self.calling:
            self.calling = None
            took = now - self._began
        target = self._targets.get(name)
        if target is not None:
            longest = LONGEST_FAR if target.far else LONGEST_NEAR
            pause = min(longest, PAUSE * 2.0 ** min(target.failures, 16))
            target.failures += 1
            if self._callers and target.failures > self._eager:
                pause = max(pause, took * self._callers / OTHERS_SHARE)
            target.next_at = now + pause * (1.0 - JITTER + 2.0 * JITTER * self._random())

    def hurry(self, name: str, now: float) -> None:
        """Call a target now, since it has shown that it is there."""
        if (target := self._targets.get(name)) is not None:
            target.failures, target.next_at = 0, now

    def next_deadline(self) -> float:
        """Return the time at which `take` returns a target."""
        if self.calling is not None:
            return _NEVER
        return min((target.next_at for target in self._targets.values()), default=_NEVER)


REFUSED = {
    frames.BAD_FRAME: "bad_frames",
    frames.BAD_VERSION: "refused_version",
    frames.BAD_NETWORK: "refused_network",
    frames.BAD_ROBOT: "refused_robot",
    frames.NOT_NEIGHBOUR: "refused_not_neighbour",
    frames.BAD_SECURITY: "refused_security",
    frames.BAD_ROLE: "refused_role",
    frames.SILENT: "silent",
    frames.BAD_KEY: "refused_key",
    frames.BAD_TAG: "bad_tags",
    frames.FULL: "refused_full",
    frames.HELD: "refused_held",
    frames.CLASH: "refused_clash",
}
"""The counter for each reason to end a connection."""


@frozen
class Local:
    """The data of this robot that a session needs."""

    robot: str
    network: str
    incarnation: int
    """u64, drawn anew at each start."""
    insecure: bool
    """True = no link of ours is authenticated, and `keys` is empty."""
    dials: dict[str, bool]
    """The robots it may be linked with, and whether it dials them (the other end does otherwise). A change of the hub
    changes it in place."""
    robots: frozenset[str]
    """All robots of the swarm."""
    times: MeshConfig = MeshConfig()
    """Holds `heartbeat`, `suspect`, `dead`, `handshake` and `patience` of the links. No other setting of it is used."""
    pages: bool = False
    """Whether a call keeps the radio from other links, as a page of Bluetooth does; then callers are known by their
    addresses, too."""
    keys: Mapping[int, bytes] = field(default_factory=dict, repr=False)
    """Pre-shared keys by id; the newest one has the highest id."""

    @property
    def process(self) -> int:
        """The number of this mesh process in link states, u32."""
        return process_of(self.incarnation)


def process_of(incarnation: int) -> int:
    """Return the number in link states of the mesh process with this incarnation, u32."""
    return incarnation & 0xFFFFFFFF


def refusal(
    hello: frames.Hello,
    local: Local,
    *,
    dialled: str | None,
    expected: str | None,
    may_call: Callable[[str], bool],
    has_room: Callable[[str], bool],
    is_held: Callable[[str], bool],
    clash: Callable[[str, int], str],
) -> tuple[int, str] | None:
    """Return why the sender of a HELLO is refused, as code of BYE and text; None = it may prove that it holds the key.

    `dialled` names whom we called, None where we were called; `expected` names the robot whose address a caller has,
    where the transport knows it; `may_call(robot)` says whether a robot that we dial may call us, `has_room(robot)`
    whether it may have a link with us, `is_held(robot)` whether an operator wants none for now, `clash(robot, process)`
    why not, where another robot has its name.
    """
    key_id = newest_common(local.keys, hello.key_ids)
    refused = None
    if hello.network != local.network:
        refused = frames.BAD_NETWORK, f"network {hello.network!r}, ours is {local.network!r}"
    elif hello.insecure != local.insecure:
        ends = ("it is", "we are not") if hello.insecure else ("we are", "it is not")
        refused = frames.BAD_SECURITY, f"{ends[0]} insecure and {ends[1]}"
    elif hello.robot == local.robot:
        refused = frames.BAD_ROBOT, f"it calls itself {hello.robot}, which is our own name"
    elif hello.robot not in local.robots:
        refused = frames.BAD_ROBOT, f"robot {hello.robot} is not in our configuration"
    elif dialled is not None and hello.robot != dialled:
        refused = frames.BAD_ROBOT, f"robot {hello.robot} answers where {dialled} should be"
    elif expected is not None and hello.robot != expected:
        refused = frames.BAD_ROBOT, f"robot {hello.robot} calls from the address of {expected}"
    elif hello.robot not in local.dials:
        refused = frames.NOT_NEIGHBOUR, f"robot {hello.robot} has no address that links could lead to"
    elif hello.dialler == (dialled is not None):
        refused = frames.BAD_ROLE, "both ends claim the same role"
    elif hello.dialler and local.dials[hello.robot] and not may_call(hello.robot):
        refused = frames.BAD_ROLE, f"{local.robot} is to dial {hello.robot}, not the other way round"
    elif not local.insecure and key_id is None:
        ids = _ids(hello.key_ids), _ids(local.keys)
        refused = frames.BAD_KEY, "robot {} has another key: {}, ours is {}".format(hello.robot, *ids)
    elif reason := clash(hello.robot, process_of(hello.incarnation)):
        refused = frames.CLASH, reason
    elif not has_room(hello.robot):
        refused = frames.FULL, f"robot {hello.robot} calls, but there is no room for another link"
    elif is_held(hello.robot):
        refused = frames.HELD, frames.BYE_TEXT[frames.HELD]
    return refused


def _ids(ids: Iterable[int]) -> str:
    """Key ids as the key file writes them."""
    return " ".join(f"{key_id:08x}" for key_id in sorted(ids, reverse=True)) or "none"
