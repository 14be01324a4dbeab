"""Every message on the bus and the key it travels under. One place, so that no two services can disagree.

Payloads are msgpack maps with these field names (`swarm.codec`). SI units: m, rad, s, V. `t` is the sender's
monotonic clock in seconds, common to all processes of one robot; the mesh relates the robots' clocks. The
only binary payloads are what apps send each other: frames of the synchronous overlay (`swarm.core.lockstep`) and
what they flood and send (`swarm.overlays`).
"""

from dataclasses import dataclass

from swarm.codec import Value, decode
from swarm.errors import PayloadError
from swarm.keys import STOP, parse


@dataclass(frozen=True, slots=True)
class Status:
    """Life cycle of a service, on `swarm/<robot>/<service>/status`: sent on change, answered to queries."""

    t: float
    service: str
    state: str
    """starting, ready, degraded or stopping."""
    reason: str
    """Why it is degraded or not yet ready; empty when ready."""
    pid: int
    since: float
    """Time of the last change of state."""
    counters: dict[str, int]
    """What was dropped, refused or retried since the start, by name."""


@dataclass(frozen=True, slots=True)
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


@dataclass(frozen=True, slots=True)
class Links:
    """All mesh links of a robot, on `swarm/<robot>/mesh/links`: on change and once a second."""

    t: float
    links: tuple[LinkState, ...]


@dataclass(frozen=True, slots=True)
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


@dataclass(frozen=True, slots=True)
class MemberChange:
    """What has happened to a robot."""

    t: float
    robot: str
    what: str
    """join, leave, crash, partition, heal, return or restart."""


@dataclass(frozen=True, slots=True)
class Members:
    """Who is in the swarm, on `swarm/<robot>/mesh/members`: on change, every 10 s, and as answer to queries."""

    t: float
    members: tuple[Member, ...]
    """All other robots of the configuration."""
    changes: tuple[MemberChange, ...]
    """The newest 32, the newest last."""


@dataclass(frozen=True, slots=True)
class FloodRequest:
    """Command on `mesh/set/flood`: carry a payload to the whole swarm, and say in `mesh/flooded` whom it reached.

    It appears on every other robot's bus, raw, under `swarm/<this robot>/app/<app>/flood`.
    """

    ticket: str
    """Names this request; a repetition of it is not flooded again but gets the answer again."""
    app: str
    payload: bytes
    priority: str
    """control, sync or bulk."""
    announce: bool
    """Whether the answer is flooded, too: every robot learns that the flood is complete."""


@dataclass(frozen=True, slots=True)
class Flooded:
    """End of a flood, on `swarm/<robot>/mesh/flooded` of its origin; elsewhere only where it is announced."""

    t: float
    """At the origin."""
    ticket: str
    app: str
    robots: tuple[str, ...]
    """Whom it reached, besides the origin."""
    complete: bool
    """Whether these are all that could be reached."""
    problem: str
    """Why it is not complete; empty otherwise."""


@dataclass(frozen=True, slots=True)
class SendRequest:
    """Command on `mesh/set/send`: carry a payload to one robot, and say in `mesh/sent` whether it arrived.

    It appears on that robot's bus, raw, under `swarm/<this robot>/app/<app>/send/<to>`.
    """

    ticket: str
    app: str
    to: str
    payload: bytes
    priority: str
    timeout: float
    """s after which it is given up."""


@dataclass(frozen=True, slots=True)
class Sent:
    """End of a message, on `swarm/<robot>/mesh/sent`."""

    t: float
    ticket: str
    app: str
    to: str
    delivered: bool
    """Whether the other robot's mesh has confirmed it."""
    problem: str
    """Why not; empty otherwise. It may have arrived all the same where the answer was lost."""


@dataclass(frozen=True, slots=True)
class Arm:
    """Command on `mesh/set/arm`: take back every stop of the swarm that this robot knows of."""

    t: float
    origin: str
    """Who takes them back."""


@dataclass(frozen=True, slots=True)
class Stopped:
    """Whether the swarm is stopped, on `swarm/<robot>/mesh/stopped`: on change, and each second while it is."""

    t: float
    stopped: bool
    by: dict[str, str]
    """The robots whose stop holds, with its reason."""


@dataclass(frozen=True, slots=True)
class Clock:
    """The mesh clock C(t') = t' + offset + rate (t' - t), on `swarm/<robot>/mesh/clock`, once a second and on change.

    `swarm.mesh_clock` reads it. It slews, but may step, also backwards, when robots or swarms meet.
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


@dataclass(frozen=True, slots=True)
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


@dataclass(frozen=True, slots=True)
class Echo:
    """An answer to a ping, or why there is none, on `swarm/<robot>/mesh/echo`."""

    t: float
    peer: str
    sequence: int
    index: int
    """Which of the request's pings, from 0."""
    size: int
    rtt: float | None
    """From handing the ping to the link's queue until its answer was there, s; None where it could not be sent."""
    reason: str
    """Why it could not be sent; empty otherwise."""


@dataclass(frozen=True, slots=True)
class BalancerState:
    """The body, on `swarm/<robot>/balancer/state` at 25 Hz."""

    t: float
    mode: str
    """starting, idle, standing_up, balancing or fault."""
    tilt: float
    """From upright, rad; positive = falling forward."""
    tilt_rate: float
    """rad/s."""
    speed: float
    """Forward speed of the axle, m/s."""
    duty_left: float
    """Motor command, -1..1."""
    duty_right: float
    battery: float | None
    """V; None before it was read."""
    ticks: int
    """Control steps since the loop started."""
    late_p99: float
    """99th percentile of the loop's lateness over the last second, s."""
    late_max: float
    fault: str
    """Why the motors are off; empty when there is no fault."""
    missed: int = 0
    """Ticks left out since the start because the loop was late by a period or more."""
    bus_errors: int = 0
    """Failed I2C transfers since the start."""


@dataclass(frozen=True, slots=True)
class Odometry:
    """Wheel travel, on `swarm/<robot>/balancer/odometry` at 25 Hz; integrated at 100 Hz, nothing is lost."""

    t: float
    sequence: int
    left: float
    """Distance rolled by the left wheel since the loop started, corrected by body pitch, m."""
    right: float
    heading: float
    """Integrated from the wheels, rad, counter-clockwise positive, 0 at the start of the loop."""


@dataclass(frozen=True, slots=True)
class Leds:
    """LEDs as they are (`balancer/leds`) or shall be (`balancer/set/leds`)."""

    red: bool
    yellow: bool
    green: bool


@dataclass(frozen=True, slots=True)
class SetMode:
    """Command on `balancer/set/mode`."""

    mode: str
    """stand (stand up and balance) or rest (motors off)."""


@dataclass(frozen=True, slots=True)
class Stop:
    """On `swarm/stop`: every robot switches its motors off."""

    t: float
    origin: str
    reason: str


@dataclass(frozen=True, slots=True)
class Range:
    """The distance to one anchor (or to the target, which is a module like any other)."""

    anchor: str
    """Short UWB address as printed on the module and in shell output, e.g. C933."""
    distance: float
    """m, calibrated and filtered as the service is configured."""
    raw: float
    """m, as the module reported it."""
    quality: int
    """0-100 as the module reported it."""
    age: float
    """s since it was measured, at `t` of the message."""
    sequence: int
    """Counts new measurements of this anchor; a repeat keeps its number."""


@dataclass(frozen=True, slots=True)
class Ranges:
    """All ranges of one module report, on `swarm/<robot>/dwm/ranges` at 10 Hz."""

    t: float
    sequence: int
    ranges: tuple[Range, ...]


@dataclass(frozen=True, slots=True)
class Pose:
    """Where the robot is, on `swarm/<robot>/dwm/pose` at 10 Hz."""

    t: float
    """When it was measured: a repeat of the module keeps time and sequence."""
    sequence: int
    """The number of the module report it comes from, as in `Ranges`."""
    x: float
    """m, in the frame of the anchors."""
    y: float
    heading: float | None
    """rad, counter-clockwise from x; None where the filter does not estimate it."""
    quality: int
    """0-100; 0 = no fix, the numbers are not to be used."""
    source: str
    """Which filter made it."""


@dataclass(frozen=True, slots=True)
class Measurement:
    """Row k of a replayed recording, answered by `dwm/measurement?sequence=k`: range to target, own place."""

    t: float
    """The recording's own time, s since its start: a row has one answer, whenever it is asked for."""
    sequence: int
    distance: float
    """Range to the target, m."""
    x: float
    """Own position, m."""
    y: float


@dataclass(frozen=True, slots=True)
class AppState:
    """An app's shared state by name, on `swarm/<robot>/app/<app>/state`, at most 25 Hz and at the end."""

    t: float
    k: int
    """Iteration."""
    state: dict[str, Value]
    result: dict[str, Value]
    """What the app reports as its result so far (units in docs of the app)."""


@dataclass(frozen=True, slots=True)
class AppProgress:
    """What an app is doing, on `swarm/<robot>/app/<app>/progress`: on change and once a second."""

    t: float
    phase: str
    """starting, waiting, running, done or fault."""
    k: int
    waiting_for: tuple[str, ...]
    """Neighbours whose value is missing (named within 3 s)."""
    reason: str
    """Why it is in fault or waits; empty otherwise."""


@dataclass(frozen=True, slots=True)
class Truth:
    """True pose of a simulated robot, on `swarm/<robot>/sim/truth` at 10 Hz."""

    t: float
    x: float
    y: float
    heading: float
    tilt: float


TOPICS: dict[tuple[str, str], type] = {
    ("*", "status"): Status,
    ("mesh", "links"): Links,
    ("mesh", "members"): Members,
    ("mesh", "flooded"): Flooded,
    ("mesh", "sent"): Sent,
    ("mesh", "stopped"): Stopped,
    ("mesh", "set/flood"): FloodRequest,
    ("mesh", "set/send"): SendRequest,
    ("mesh", "set/arm"): Arm,
    ("mesh", "clock"): Clock,
    ("mesh", "echo"): Echo,
    ("mesh", "set/echo"): EchoRequest,
    ("balancer", "state"): BalancerState,
    ("balancer", "odometry"): Odometry,
    ("balancer", "leds"): Leds,
    ("balancer", "set/leds"): Leds,
    ("balancer", "set/mode"): SetMode,
    ("dwm", "ranges"): Ranges,
    ("dwm", "pose"): Pose,
    ("dwm", "measurement"): Measurement,
    ("app", "*/status"): Status,
    ("app", "*/state"): AppState,
    ("app", "*/progress"): AppProgress,
    ("sim", "truth"): Truth,
}
"""Message type of each key, by (service, topic); `*` is any one chunk. A test compares docs/keys.md to it."""


def type_of(key: str) -> type | None:
    """The message type that travels under `key`, None where the key is none of ours.

    Raises `PayloadError` for a key that is not even well formed.
    """
    if key == STOP:
        return Stop
    _, service, topic = parse(key)
    _, _, tail = topic.partition("/")
    for candidate in ((service, topic), (service, f"*/{tail}"), ("*", topic)):
        if candidate in TOPICS:
            return TOPICS[candidate]
    return None


def read(key: str, payload: bytes) -> object:
    """Decode a payload by its key; `PayloadError` where the key is unknown or the payload not of its type."""
    kind = type_of(key)
    if kind is None:
        raise PayloadError(f"{key}: no message travels under this key (docs/keys.md lists them)")
    return decode(kind, payload, key)
