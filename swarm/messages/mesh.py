"""Messages of the mesh service."""

from dataclasses import field

from swarm.frozen import frozen
from swarm.messages.codec import Short, with_telemetry


@frozen
class LinkState:
    """One mesh link as its own robot sees it."""

    peer: str
    state: str
    """down, connecting, up or suspect."""
    connection: int
    """The number of connections so far. It shows that the link was renewed, even between two samples."""
    rtt: float | None
    """Smoothed round-trip time, s; None before the first heartbeat came back."""
    sent: int
    """Frames sent since the service started."""
    received: int
    reason: str
    """Why the link is down; empty otherwise."""
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
    """The mesh links of a robot, published on `swarm/<robot>/mesh/links` on change and once a second."""

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
    """here (there is a path to it), left (it announced its stop), gone, or never (not seen yet)."""
    since: float
    """Time of the last change of state."""
    hops: int | None
    """Hops on the path to the robot; None without a path."""
    via: str | None
    """The neighbour with which the path begins."""


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
    """The other robots of the configuration, by name; the first 500 of them."""
    changes: tuple[MemberChange, ...]
    """The newest 32, the newest last."""


@frozen
class Arm:
    """Command on `mesh/set/arm`: take back every stop of the swarm that this robot knows of."""

    t: float
    origin: Short
    """The robot that takes them back."""
    age: float = 0.0
    """Seconds since the command was given first. A repeated command takes back only stops that the robot knew by then,
    and none that was given meanwhile."""


@frozen
class Stopped:
    """The stop's state, on `swarm/<robot>/mesh/stopped`: on change, and each second. Changes are flooded,
    so every robot's bus has the state of every robot."""

    t: float
    stopped: bool
    by: dict[str, str]
    """The robots whose stop holds, with its reason; 16 of them where there are more, this one first."""


@frozen
class Watch:
    """Somebody watches the swarm through a robot: on `swarm/<robot>/mesh/set/watch`, again before the time is over.
    Its mesh floods it as `swarm/<robot>/mesh/watch`, and all others send it a `View` a second meanwhile."""

    t: float
    seconds: float
    """Seconds for which the request is valid, at most 60."""


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
    """Hops on the path to the robot; None without a path."""
    via: str | None
    """The neighbour with which the path begins."""
    links: dict[str, float]
    """The links that the robot reports, with their one-way times, s. A link counts only if both of its ends report
    it."""
    stopped: bool | None
    """Whether the robot reports that it is stopped; None: it has reported nothing since it was started."""


@frozen
class MeshGraph:
    """The whole swarm as one robot knows it, the answer to queries of `swarm/<robot>/mesh/graph`."""

    t: float
    robots: tuple[GraphRobot, ...]
    """At most 100 robots by name. The query `?after=NAME` asks for the robots that follow NAME."""
    more: bool
    """Whether more robots follow the last one."""


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

    peer: Short
    sequence: int
    """A number that the answers repeat."""
    size: int
    """Bytes of each ping's payload, at least 11."""
    count: int = 1
    """Pings sent at once."""
    priority: Short = "sync"
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
    """Why the ping could not be sent; empty otherwise."""


@frozen
class HoldLink:
    """Command on `mesh/set/hold`: have no link with a neighbour for a while. One end suffices: it ends the connection
    and refuses others. `mesh/links` tells it."""

    peer: Short
    seconds: float
    """Seconds for which the link is held down, at most 600; 0: the link may come back now. A mesh that starts holds no
    link."""


@frozen
class TopologyRequest:
    """Command on `mesh/set/topology`: other links for the whole swarm; the answer is a `TopologySet`."""

    ticket: Short
    """The name of this request. A repetition of it gets the same answer and is not carried out again."""
    shape: Short
    """line, loop, full, thesis-d, random:SEED or auto; empty if `edges` gives the links."""
    edges: tuple[tuple[Short, Short], ...]
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
class MeasuredHub:
    """The robot that calls all others, where measured round trips decide which one that is (`links = auto`)."""

    robot: str
    round_trip: float | None
    """Mean round trip between the hub and the robots in its reach over the last 30 s, s; None: this robot is not the
    hub, or has measured nothing yet."""
    before: str
    """The hub before it; empty if there was none."""
    round_trip_before: float | None
    """The mean round trip of that one, s; None: not measured."""
    trial: bool
    """Whether the hub is on trial."""


@frozen
class Topology:
    """The topology in force on a robot, on `swarm/<robot>/mesh/topology`: on change, and as answer to queries."""

    t: float
    version: int
    """The number of topologies that were set so far; 0: that of the configuration."""
    step: int
    """Counts the changes of the automatic rule and of the hub within a version."""
    issuer: str
    """The robot at which it was set or changed; empty for the configuration's own."""
    auto: bool
    """Whether the automatic rule changes it."""
    since: float
    """The time at which this robot took it over."""
    edges: tuple[tuple[str, str], ...]
    """All neighbours of the swarm, each pair once."""
    wanted: tuple[str, ...]
    """The neighbours of this robot in this topology."""
    up: tuple[str, ...]
    """The neighbours whose links are up, or to which other links lead."""
    kept: tuple[str, ...]
    """Links that are up and not part of the topology: either they alone hold the swarm together, or they are about to
    end."""
    missing: dict[str, str]
    """Robots out of reach that this robot has called, and why each call failed."""
    links: tuple[tuple[str, str], ...] = ()
    """Links that carry the topology, where these are not its own."""
    hub: MeasuredHub | None = None
    """None where the hub is not chosen by measurement."""

    @property
    def number(self) -> str:
        """Return version and step as people read them; the step only where there may be one."""
        return f"{self.version}.{self.step}" if self.auto or self.step else str(self.version)


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
