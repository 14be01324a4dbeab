"""The types of a `Config`: what one `swarm.toml` says about the whole swarm. The same file is on every robot.

Loading and checking is `swarm.config.load`, the commented example `swarm.config.example`.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

from swarm.core.graph import Graph
from swarm.frozen import frozen
from swarm.messages.codec import Value

DEFAULT_KEY_FILE = "/etc/swarm/key"

GRAPH, STAR, TREE, AUTO_LINKS = "graph", "star", "tree", "auto"
LINKS = (GRAPH, STAR, TREE, AUTO_LINKS)
"""The choices of links that carry the topology: its own, one hub's, those of several hubs, or what suits the radio."""

MAX_RFCOMM_LINKS = 7
"""A Bluetooth Classic master has at most seven active slaves (Core specification, vol 2 B, 8.6: LT_ADDR)."""


@frozen
class RobotConfig:
    """One robot of the swarm."""

    name: str
    board: str = "zero2w"
    """The Raspberry Pi: zero2w or pi4. It sets the body's mass."""
    bluetooth: str | None = None
    """Address of the Bluetooth adapter, B8:27:EB:12:34:56."""
    link: str | None = None
    """The address for other robots where it is not Bluetooth: `tcp:HOST:PORT`; in a simulation `sim:SOCKET`, or
    `slots:SOCKET` with its Bluetooth radio."""
    host: str | None = None
    """The address for ssh: a name of ~/.ssh/config, or user@address; None: the robot's own name."""
    uwb: str | None = None
    """Short address of its DWM1001, such as C933, by which `dwm/ranges` of the others name the robot."""
    uwb_role: str = "tag"
    """tag (finds its place) or anchor (others range to it; it knows no place of its own)."""
    i2c_clock: int = 100
    """The clock of the I2C bus that `swarm provision` sets: 100 or 400 kHz."""


@frozen
class RelayRule:
    """A rule that names keys on the robot's own bus which the mesh carries to other robots."""

    keys: str
    """Key expression. `{self}` stands for the own name, and `{peer}` (a whole chunk) for the robot that the message
    goes to."""
    overlay: str = "neighbours"
    """neighbours (one link), flood (the whole swarm) or unicast (the robot `{peer}`); of the rules that are always in
    force also around (the neighbour `{peer}`, over other robots than the link)."""
    priority: str = "bulk"
    """control, sync or bulk."""
    queue: str = "latest"
    """latest (a newer value replaces a waiting one of its key) or all (in order, none replaced)."""
    max_rate: float | None = None
    """The most messages a second of each key, for `latest`; None: all that are published."""


DEFAULT_RELAY = (
    RelayRule("swarm/{self}/app/*/sync/*", priority="sync", queue="all"),
    RelayRule("swarm/{self}/app/*/sync/*/{peer}", priority="sync", queue="all"),
    RelayRule("swarm/{self}/app/*/sync/*/{peer}/around", overlay="around", priority="sync", queue="all"),
    RelayRule("swarm/{self}/app/*/latest/*", priority="sync", queue="latest"),
)
"""Always in force, before the rules of the file: what synchronous apps say to all neighbours, to one, and to one whose
link is silent, and what event-driven and periodic ones say to all."""


@frozen
class Anchor:
    """A UWB module at a known place."""

    address: str
    """Short address as printed, four hex digits: C933."""
    x: float
    y: float
    z: float = 0.0


@frozen
class MeshConfig:
    """Mesh settings; docs/reference/network/frames.md says why the times are as they are."""

    insecure: bool = False
    """True: links are not authenticated, and anyone in reach can join."""
    key: str | None = None
    """Path of the file with the pre-shared key; None: the usual place. Not used if `insecure` is true."""
    listen: str | None = None
    """The address HOST:PORT for `tcp:` neighbours; without it nothing listens on the network."""
    heartbeat: float = 0.5
    """Seconds between heartbeats."""
    suspect: float = 1.5
    """Seconds of silence after which a link is suspect. On a slow link the time follows from its round trips if that is
    longer."""
    dead: float = 3.0
    """Seconds of silence after which a link is closed and dialled again. On a slow link it is longer in the same
    way."""
    handshake: float = 8.0
    """Seconds that each half of a handshake may take. The time doubles after each handshake that was not answered."""
    patience: float = 60.0
    """Upper bound of these times in seconds, however slow a link is."""
    metric: str = "hops"
    """What the length of a route is measured in: hops, or time (as measured)."""
    links: str = AUTO_LINKS
    """The links that carry the topology: graph (its own), star (the first robot of the file calls all others), tree
    (the same with several hubs) or auto (star or tree on Bluetooth, graph elsewhere; measured round trips choose the
    hub of a star)."""
    rfcomm_channel: int = 1
    """RFCOMM channel at which the mesh of every robot listens, 1 to 30 (bluetoothd -C uses channel 8)."""
    rfcomm_encrypt: bool = False
    """Whether Bluetooth itself encrypts `rfcomm:` links. This needs bluetoothd, and pairing without questions."""

    @property
    def key_file(self) -> Path | None:
        """Return the path of the pre-shared key; None when insecure."""
        return None if self.insecure else Path(self.key or DEFAULT_KEY_FILE)


@frozen
class Body:
    """Parameters of the robots' bodies and the balancer."""

    wheel_radius: float = 0.040
    gear_ratio: float = 110.25
    """Motor turns for one wheel turn: 50:1 motor (51.45) with 45:21 gears."""
    track: float = 0.11
    """Distance between the wheels, m."""
    trim: float = 0.0
    """Tilt of the balance point from the IMU's upright, rad."""
    payload: float | None = None
    """Mass of what was added to the robot as sold (Pi, UWB module, display), kg; None: as `board` implies."""
    payload_height: float = 0.071
    """Height of the payload's centre of mass above the axle, m."""


@frozen
class Balancing:
    """The settings of the balancer for one kind of body."""

    controller: str = "lqr"
    """lqr, or pololu (its algorithm and constants), or thesis (the same with the thesis' constants)."""
    max_speed: float = 0.5
    """Highest speed, m/s."""
    max_turn_rate: float = 3.0
    """Highest turn rate, rad/s."""
    acceleration: float = 0.5
    """Acceleration in driving, m/s^2."""
    turn_acceleration: float = 6.0
    """Turn acceleration, rad/s^2."""
    battery_warning: float = 6.6
    """Voltage below which the robot warns, V: 1.1 V for each of six cells."""
    battery_limit: float = 6.0
    """Voltage below which the robot lies down, V. NiMH cells are damaged below 1 V each."""
    flip_left_motor: bool = False
    """Whether the left motor's wires are reversed: a command to go forward is written as one to go backward."""
    flip_right_motor: bool = False


@frozen
class Linear:
    """Calibrated distance = gain * measured + offset (thesis eq. 2.8)."""

    gain: float = 1.0
    offset: float = 0.0
    """Offset of a range, m."""


@frozen
class Affine:
    """Calibrated position = matrix * measured + offset (thesis eq. 2.10)."""

    matrix: tuple[tuple[float, float], tuple[float, float]] = ((1.0, 0.0), (0.0, 1.0))
    offset: tuple[float, float] = (0.0, 0.0)
    """Offset of a place, m."""


@frozen
class Dwm:
    """UWB module, calibration and filter."""

    source: str = "serial:/dev/serial0"
    """serial:PATH (a DWM1001 in generic mode), balancer (one that is wired to the ATmega32U4), bus:KEY (another program
    on the robot's bus) or replay:DIR (a recording); `{robot}` stands for the own name."""
    target: str | None = None
    """Address of the UWB module that is the target."""
    rate: float = 10.0
    """Measurements a second; the module's maximum is 10."""
    filter: str = "auto"
    """The filter that estimates the pose: ekf, multilateration or average. auto stands for ekf while there is odometry,
    and else for average."""
    filters: Mapping[str, str] = field(default_factory=dict)
    """Filters of single robots by name, in place of `filter`."""
    window: int = 5
    """Number of ranges in the moving average; 1: no averaging."""
    position_window: int | None = None
    """Number of places in the moving average; None: as `window`."""
    latency: float = 0.06
    """Seconds from a measurement until its report is read."""
    height: float = 0.0
    """Height of the robots' antennas in the frame of the anchors, m."""
    lever: float = 0.0
    """Height of the antenna above a robot's axle, m. The antenna moves on this lever when the body leans."""
    calibration: str | None = None
    """File that `swarm calibrate` writes; `{robot}` stands for the own name. Its models replace `distance` and
    `position`."""
    distance: Linear = field(default_factory=Linear)
    position: Affine = field(default_factory=Affine)

    def filter_of(self, robot: str) -> str:
        """Return the name of the filter that estimates the pose of `robot`."""
        return self.filters.get(robot, self.filter)


@frozen
class AppConfig:
    """Parameters of one app: common ones, and those of single robots on top."""

    parameters: Mapping[str, Value] = field(default_factory=dict)
    robots: Mapping[str, Mapping[str, Value]] = field(default_factory=dict)

    def of(self, robot: str) -> dict[str, Value]:
        """Return the parameters that hold on `robot`."""
        return {**self.parameters, **self.robots.get(robot, {})}


@frozen
class Recordings:
    """The limits of the recordings that a robot keeps."""

    budget: float = 2e9
    """Bytes that the recordings of a robot may take. Beyond that the robot deletes the oldest finished runs."""


@frozen
class SimulationConfig:
    """The places at which simulated robots and the target start; only `swarm sim` reads them."""

    target: tuple[float, float] = (0.5, 1.0)
    """The target's place, m."""
    target_velocity: tuple[float, float] = (0.0, 0.0)
    """The target's velocity from the first iteration of all robots on, m/s."""
    places: Mapping[str, tuple[float, float, float]] = field(default_factory=dict)
    """The first place (x, y in m) and heading (rad) of each robot, by name."""
    scl: float | None = None
    """The clock of the simulated I2C bus, Hz. None, here and below: as the data sheets of the parts say."""
    battery: float | None = None
    """The battery's voltage, V."""
    gyro_noise: float | None = None
    """Standard deviation of a sample, rad/s."""
    acceleration_noise: float | None = None
    """Standard deviation of a sample, m/s^2."""
    range_noise: float | None = None
    """Standard deviation of a UWB range in line of sight, m."""

    @property
    def moving(self) -> bool:
        """Whether the target moves."""
        return self.target_velocity != (0.0, 0.0)

    def target_after(self, seconds: float) -> tuple[float, float]:
        """Return the target's place (x, y) in m, `seconds` after the first iteration of all robots. Before that it
        stands."""
        (x, y), (vx, vy), t = self.target, self.target_velocity, max(0.0, seconds)
        return (x + vx * t, y + vy * t)


@dataclass(frozen=True)
class Config:
    """The whole swarm."""

    path: Path
    network: str
    """The name of the swarm's network. A mesh refuses robots of another network."""
    robots: tuple[RobotConfig, ...]
    edges: tuple[tuple[str, str], ...]
    """The first topology: each link once, as (name, name) in the order of `robots`."""
    relay: tuple[RelayRule, ...]
    anchors: tuple[Anchor, ...] = ()
    mesh: MeshConfig = field(default_factory=MeshConfig)
    body: Body = field(default_factory=Body)
    bodies: Mapping[str, Body] = field(default_factory=dict)
    """The bodies of robots that differ from `body`."""
    balancing: Balancing = field(default_factory=Balancing)
    balancings: Mapping[str, Balancing] = field(default_factory=dict)
    """The balancers' settings of robots that differ from `balancing`."""
    dwm: Dwm = field(default_factory=Dwm)
    apps: Mapping[str, AppConfig] = field(default_factory=dict)
    recordings: Recordings = field(default_factory=Recordings)
    simulation: SimulationConfig = field(default_factory=SimulationConfig)
    packages: tuple[str, ...] = ()
    """Further Python packages that robots carry, by their names for pip, for apps that import them."""
    auto: bool = False
    """Whether the robots find their links themselves; `edges` is empty then."""

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Robots' names in the order of the file."""
        return tuple(robot.name for robot in self.robots)

    @cached_property
    def graph(self) -> Graph:
        """The topology to begin with."""
        return Graph(self.names, self.edges)

    def robot(self, name: str) -> RobotConfig:
        """Return the robot called `name`; KeyError where there is none."""
        for robot in self.robots:
            if robot.name == name:
                return robot
        raise KeyError(name)

    def body_of(self, name: str) -> Body:
        """Return the body of a robot."""
        return self.bodies.get(name, self.body)

    def balancing_of(self, name: str) -> Balancing:
        """Return the balancer's settings of the robot `name`."""
        return self.balancings.get(name, self.balancing)

    @property
    def robots_by_module(self) -> dict[str, str]:
        """Name of the robot that carries a UWB module, by the module's address."""
        return {robot.uwb: robot.name for robot in self.robots if robot.uwb is not None}

    def neighbours(self, name: str) -> tuple[str, ...]:
        """Return the names of the robots linked to `name` in the topology to begin with, sorted."""
        return self.graph.neighbours(name)

    def app(self, name: str) -> AppConfig:
        """Parameters of an app; empty ones where the file says nothing of it."""
        return self.apps.get(name, AppConfig())
