"""Messages of the mesh service."""

from dataclasses import field

from swarm.frozen import frozen
from swarm.messages.codec import with_telemetry


@frozen
class LinkState:
    """One mesh link as its own robot sees it."""

    peer: str
    state: str
    """down, connecting, up or suspect."""
    connection: int
    """Counts the connections so far: a change tells that the link was renewed, even between two samples."""
    rtt: float | None
    """Smoothed round-trip time, s; None before the first heartbeat came back."""
    sent: int
    """Frames sent since the service started."""
    received: int
    reason: str
    """Why it is down; empty otherwise."""
    rtt_min: float | None = None
    """Smallest round-trip time of the heartbeats of the last minute, s; likewise median and 99th percentile."""
    rtt_median: float | None = None
    rtt_p99: float | None = None
    sent_rate: float = 0.0
    """bytes/s, over the last second or so."""
    received_rate: float = 0.0
    sent_bytes: int = 0
    """Since the service started."""
    received_bytes: int = 0
    queue: int = 0
    """Bytes that wait to leave."""
    in_flight: int = 0
    """Bytes that have left and are not acknowledged."""
    window: int = 0
    """Bytes that may be in flight before bulk has to wait."""
    dropped: int = 0
    """Messages for this neighbour that were lost: the link was down or its queue full."""
    refused: int = 0
    """Connections to or from this neighbour that were refused."""
    role: str = ""
    """This robot's role in a Bluetooth connection: central or peripheral; empty where there is none, or not known."""
    wanted_role: str = ""
    """The role that it is to have there: who calls is to be central. Empty where `role` is."""


@frozen
class Links:
    """All mesh links of a robot, on `swarm/<robot>/mesh/links`: on change and once a second."""

    t: float
    links: tuple[LinkState, ...]
    clashes: dict[str, str] = field(default_factory=dict)
    """The signs that two robots have one name, in words, by that name. Empty in a well swarm. See
    docs/explanation/two-robots-with-one-name.md."""


@frozen
class Member:
    """Another robot of the swarm, as one robot sees it."""

    robot: str
    state: str
    """here (there is a way to it), left (it said that it stops), gone, or never (not seen yet)."""
    since: float
    """Time of the last change of state."""
    hops: int | None
    """Links on the way to it; None where there is no way."""
    via: str | None
    """The neighbour that the way begins with."""


@frozen
class MemberChange:
    """A change in the membership of a robot."""

    t: float
    robot: str
    what: str
    """join, leave, crash, partition, heal, return or restart."""


@frozen
class Members:
    """The robots of the swarm, on `swarm/<robot>/mesh/members`: on change, every 10 s, and as answer to queries."""

    t: float
    members: tuple[Member, ...]
    """All other robots of the configuration."""
    changes: tuple[MemberChange, ...]
    """The newest 32, the newest last."""


@frozen
class Arm:
    """Command on `mesh/set/arm`: take back every stop of the swarm that this robot knows of."""

    t: float
    origin: str
    """The robot that takes them back."""


@frozen
class Stopped:
    """The stop's state, on `swarm/<robot>/mesh/stopped`: on change, and each second. Changes are flooded,
    so every robot's bus has the state of every robot."""

    t: float
    stopped: bool
    by: dict[str, str]
    """The robots whose stop holds, with its reason; 16 of them where there are more."""


@frozen
class Watch:
    """Somebody watches the swarm through a robot: on `swarm/<robot>/mesh/set/watch`, again before the time is over.
    Its mesh floods it as `swarm/<robot>/mesh/watch`, and all others send it a `View` a second meanwhile."""

    t: float
    seconds: float
    """Seconds for which it holds, at most 60."""


@frozen
class View:
    """A robot's report of itself to another robot through which somebody watches, on that robot's
    `swarm/<robot>/mesh/view`."""

    t: float
    services: dict[str, str]
    """Services that have changed: `gone`, or their state (`degraded: no anchors`), or `here` where they have not told
    it."""
    values: dict[str, bytes]
    """The changes by topic (`dwm/pose`): the newest message of that key as msgpack, with a few of its fields."""


@frozen
class GraphRobot:
    """A robot as `mesh/graph` shows it."""

    robot: str
    state: str
    """self (the one that was asked), here, left, gone or never, as in `Member`."""
    since: float
    """Time of the last change of state; 0 for self."""
    hops: int | None
    """Links on the way to it; None where there is no way."""
    via: str | None
    """The neighbour that the way begins with."""
    links: dict[str, float]
    """The links it says it has, with their one-way times, s. One counts where both ends tell of it."""
    stopped: bool | None
    """Whether it says that it is stopped; None where it has not said anything since it was started."""


@frozen
class MeshGraph:
    """The whole swarm as one robot knows it, the answer to queries of `swarm/<robot>/mesh/graph`."""

    t: float
    robots: tuple[GraphRobot, ...]
    """The robots by name, at most 100; `?after=NAME` asks for those behind NAME."""
    more: bool
    """Whether there are robots behind the last one."""


@frozen
class Clock:
    """The mesh clock C(t') = t' + offset + rate (t' - t), on `swarm/<robot>/mesh/clock`, once a second and on change.

    `swarm.app.mesh_clock` reads it. It slews, but may step, also backwards, when robots or swarms meet.
    """

    t: float
    offset: float
    """Mesh time minus this robot's monotonic clock at `t`, s."""
    rate: float
    """Change of the offset, s/s."""
    root: str
    """The robot whose clock it is."""
    hop: int
    """Links between that robot and this one."""
    error: float
    """Estimated standard deviation from the root's, s; asymmetry of the links cannot be seen and is not in it."""


@frozen
class EchoRequest:
    """Measure a link: pings to a neighbour, on `mesh/set/echo`; each answer is an `Echo`."""

    peer: str
    sequence: int
    """Given back in the answers."""
    size: int
    """Bytes of each ping's payload, at least 11."""
    count: int = 1
    """Pings sent at once."""
    priority: str = "sync"
    """sync or bulk."""
    short: bool = False
    """Whether the answers are short, to measure one direction, or as long as the pings."""


@frozen
class Echo:
    """An answer to a ping, or why there is none, on `swarm/<robot>/mesh/echo`."""

    t: float
    peer: str
    sequence: int
    index: int
    """The number of the request's ping, from 0."""
    size: int
    rtt: float | None
    """Seconds from handing the ping to the link's queue until its answer was there; None where it could not be sent."""
    reason: str
    """Why it could not be sent; empty otherwise."""


@frozen
class HoldLink:
    """Command on `mesh/set/hold`: have no link with a neighbour for a while. One end suffices: it ends the connection
    and refuses others. `mesh/links` tells it."""

    peer: str
    seconds: float
    """Seconds, at most 600; 0 = the link may come back now. A mesh that starts holds none."""


@frozen
class TopologyRequest:
    """Command on `mesh/set/topology`: other links for the whole swarm; the answer is a `TopologySet`."""

    ticket: str
    """Names this request; a repetition of it is answered again, not done again."""
    shape: str
    """line, loop, full, thesis-d, random:SEED or auto; empty where `edges` say it."""
    edges: tuple[tuple[str, ...], ...]
    """Pairs of robots."""
    after: int | None
    """The version that must be in force for the change; None = any."""


@frozen
class TopologySet:
    """Answer to a `TopologyRequest`, on `swarm/<robot>/mesh/topology_set`: it holds on this robot, others follow."""

    t: float
    ticket: str
    version: int
    """The version in force on this robot."""
    problem: str
    """Why nothing was changed; empty otherwise."""


@frozen
class Topology:
    """The topology in force on a robot, on `swarm/<robot>/mesh/topology`: on change, and as answer to queries."""

    t: float
    version: int
    """Counts what was set; 0 = as configured."""
    step: int
    """Counts the changes of the automatic rule within a version."""
    issuer: str
    """The robot at which it was set; empty for the configuration's own."""
    auto: bool
    """Whether the automatic rule changes it."""
    since: float
    """The time at which this robot took it over."""
    edges: tuple[tuple[str, ...], ...]
    """All neighbours of the swarm, each pair once."""
    wanted: tuple[str, ...]
    """Neighbours of this robot in it."""
    up: tuple[str, ...]
    """The neighbours whose links are up, or to which other links lead."""
    kept: tuple[str, ...]
    """Links that are up and not in it: they alone hold the swarm together, or are about to go."""
    missing: dict[str, str]
    """Robots out of reach that this one has called, and why in vain."""
    links: tuple[tuple[str, ...], ...] = ()
    """Links that carry the topology, where these are not its own."""


TOPICS = with_telemetry(
    {
        ("mesh", "links"): Links,
        ("mesh", "members"): Members,
        ("mesh", "stopped"): Stopped,
        ("mesh", "graph"): MeshGraph,
        ("mesh", "set/arm"): Arm,
        ("mesh", "clock"): Clock,
        ("mesh", "echo"): Echo,
        ("mesh", "topology"): Topology,
        ("mesh", "topology_set"): TopologySet,
        ("mesh", "set/topology"): TopologyRequest,
        ("mesh", "set/echo"): EchoRequest,
        ("mesh", "set/hold"): HoldLink,
        ("mesh", "set/watch"): Watch,
        ("mesh", "watch"): Watch,
        ("mesh", "view"): View,
    }
)
"""Message type of each key, by (service, topic); `*` is any one chunk."""
