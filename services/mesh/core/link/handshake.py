"""Who may be at the other end of a connection: what a HELLO must say to be accepted."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import field

from services.mesh.core.wire import frames
from services.mesh.core.wire.auth import newest_common
from services.mesh.core.wire.frames import Hello
from swarm.frozen import frozen

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
"""Which counter counts what we end a connection for."""


@frozen
class Local:
    """What a session must know of this robot."""

    robot: str
    network: str
    incarnation: int
    """u64, drawn anew at each start."""
    insecure: bool
    """True = no link of ours is authenticated, and `keys` is empty."""
    dials: Mapping[str, bool]
    """The robots it may be linked with, and whether it dials them (the other end does otherwise)."""
    robots: frozenset[str]
    """All robots of the swarm."""
    heartbeat: float = 0.5
    """s between heartbeats, on a busy link too: they carry the clock."""
    suspect: float = 1.5
    dead: float = 3.0
    keys: Mapping[int, bytes] = field(default_factory=dict, repr=False)
    """Pre-shared keys by id; the newest one has the highest id."""

    @property
    def process(self) -> int:
        """The number of this mesh process in link states, u32."""
        return process_of(self.incarnation)


def process_of(incarnation: int) -> int:
    """The number in link states of the mesh process with this incarnation, u32."""
    return incarnation & 0xFFFFFFFF


def refusal(
    hello: Hello,
    local: Local,
    *,
    dialled: str | None,
    expected: str | None,
    has_room: Callable[[str], bool],
    is_held: Callable[[str], bool],
    clash: Callable[[str, int], str],
) -> tuple[int, str] | None:
    """Why the sender of a HELLO is refused, as code of BYE and text; None = it may prove that it holds the key.

    `dialled` names whom we called, None where we were called; `expected` names the robot whose address a caller has,
    where the transport knows it; `has_room(robot)` says whether that one may have a link with us, `is_held(robot)`
    whether an operator wants none for now, `clash(robot, process)` why not, where another robot has its name.
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
    elif hello.dialler and local.dials[hello.robot]:
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
