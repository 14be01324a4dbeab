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
    """zero2w or pi4: sets the body's mass."""
    bluetooth: str | None = None
    """Address of the Bluetooth adapter, B8:27:EB:12:34:56."""
    link: str | None = None
    """The address for other robots where it is not Bluetooth: `tcp:HOST:PORT`; in a simulation `sim:SOCKET`, or
    `slots:SOCKET` with its Bluetooth radio."""
    host: str | None = None
    """The robot's name for ssh (a name of ~/.ssh/config, user@address); None = its own name."""
    uwb: str | None = None
    """Short address of its DWM1001, C933; `dwm/ranges` of the others name the robot by it."""
    uwb_role: str = "tag"
    """tag (finds its place) or anchor (others range to it; it knows no place of its own)."""
    i2c_clock: int = 100
    """kHz of the I2C bus, 100 or 400: what `swarm provision` sets."""


@frozen
class RelayRule:
    """A rule that names keys on the robot's own bus which the mesh carries to other robots."""

    keys: str
    """Key expression; `{self}` is the own name, `{peer}` (a whole chunk) the robot it goes to."""
    overlay: str = "neighbours"
    """neighbours (one link), flood (the whole swarm) or unicast (the robot `{peer}`); of the rules that are always in
    force also around (the neighbour `{peer}`, over other robots than the link)."""
    priority: str = "bulk"
    """control, sync or bulk."""
    queue: str = "latest"
    """latest (a newer value replaces a waiting one of its key) or all (in order, none replaced)."""
    max_rate: float | None = None
    """Hz for each key, for `latest`; None = as published."""


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
    """True = links are not authenticated: anyone in reach can join."""
    key: str | None = None
    """Path of the file with the pre-shared key; None = the usual place. Only where not insecure."""
    listen: str | None = None
    """The address HOST:PORT for `tcp:` neighbours; without it nothing listens on the network."""
    heartbeat: float = 0.5
    """Seconds between heartbeats."""
    suspect: float = 1.5
    """Seconds of silence until a link is suspect; on a link whose round trips are long, what follows from them."""
    dead: float = 3.0
    """Seconds of silence until a link is closed and dialled anew, likewise."""
    handshake: float = 8.0
    """Seconds that each half of a handshake may take; twice that after each one that was not answered."""
    patience: float = 60.0
    """Seconds that none of these times exceeds, however slow a link is."""
    metric: str = "hops"
    """The length of a route: hops, or time (measured)."""
    links: str = AUTO_LINKS
    """The links that carry the topology: graph (its own), star (the first robot of the file calls all others), tree
    (the same with several hubs) or auto (star or tree on Bluetooth, graph elsewhere)."""
    rfcomm_channel: int = 1
    """RFCOMM channel the mesh listens at on every robot, 1 to 30 (bluetoothd -C holds 8)."""
    rfcomm_encrypt: bool = False
    """Whether Bluetooth itself encrypts `rfcomm:` links; needs bluetoothd and pairing without questions."""

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
    """Between the wheels, m."""
    trim: float = 0.0
    """Tilt of the balance point from the IMU's upright, rad."""
    payload: float | None = None
    """kg on top of the robot as sold: Pi, UWB module, display; None = what the robot's board says."""
    payload_height: float = 0.071
    """m above the axle: that payload's centre of mass."""


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
    """m/s^2, of driving."""
    turn_acceleration: float = 6.0
    """Turn acceleration, rad/s^2."""
    battery_warning: float = 6.6
    """V: 1.1 a cell of six."""
    battery_limit: float = 6.0
    """V: below it lies down; NiMH cells below 1 V suffer."""
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
    """serial:PATH (a DWM1001 in generic mode), balancer (one that is wired to the ATmega32U4) or replay:DIR (a
    recording); `{robot}` = the own name."""
    target: str | None = None
    """Address of the module that is the target."""
    rate: float = 10.0
    """Hz; the module's maximum is 10."""
    filter: str = "auto"
    """The filter that estimates the pose: ekf, multilateration or average; auto = ekf while there is odometry, else
    average."""
    filters: Mapping[str, str] = field(default_factory=dict)
    """The same for single robots, by name."""
    window: int = 5
    """Length of the moving average of ranges; 1 = off."""
    position_window: int | None = None
    """The same for places; None = as `window`."""
    latency: float = 0.06
    """Seconds from a measurement until its report is read."""
    height: float = 0.0
    """Height of the robots' antennas in the frame of the anchors, m."""
    lever: float = 0.0
    """Height of the antenna above a robot's axle, m: it swings on this lever as the body leans."""
    calibration: str | None = None
    """File made by `swarm calibrate`, `{robot}` = the own name; its models go before `distance` and `position`."""
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
        """The parameters that hold on `robot`."""
        return {**self.parameters, **self.robots.get(robot, {})}


@frozen
class Recordings:
    """The limits of the recordings that a robot keeps."""

    budget: float = 2e9
    """Bytes of its disk they may take; beyond, the oldest finished runs are deleted."""


@frozen
class SimulationConfig:
    """The places at which simulated robots and the target start; only `swarm sim` reads them."""

    target: tuple[float, float] = (0.5, 1.0)
    """The target's place, m."""
    target_velocity: tuple[float, float] = (0.0, 0.0)
    """m/s, from the first iteration of all robots on."""
    places: Mapping[str, tuple[float, float, float]] = field(default_factory=dict)
    """x, y in m and heading in rad, by robot."""
    scl: float | None = None
    """Hz: the clock of the simulated I2C bus; None here and below: as the parts' data sheets say."""
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
    """Robots of another network are refused."""
    robots: tuple[RobotConfig, ...]
    edges: tuple[tuple[str, str], ...]
    """The topology to begin with: each link once, as (name, name) in the order of `robots`."""
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
    """Python packages that robots carry beside ours, as pip names them: for apps that import them."""
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
        """The robot called `name`; KeyError where there is none."""
        for robot in self.robots:
            if robot.name == name:
                return robot
        raise KeyError(name)

    def body_of(self, name: str) -> Body:
        """The body of a robot."""
        return self.bodies.get(name, self.body)

    def balancing_of(self, name: str) -> Balancing:
        """Return the balancer's settings of the robot `name`."""
        return self.balancings.get(name, self.balancing)

    @property
    def robots_by_module(self) -> dict[str, str]:
        """Name of the robot that carries a UWB module, by the module's address."""
        return {robot.uwb: robot.name for robot in self.robots if robot.uwb is not None}

    def neighbours(self, name: str) -> tuple[str, ...]:
        """Names of the robots linked to `name` in the topology to begin with, sorted."""
        return tuple(sorted((b if a == name else a) for a, b in self.edges if name in (a, b)))

    def app(self, name: str) -> AppConfig:
        """Parameters of an app; empty ones where the file says nothing of it."""
        return self.apps.get(name, AppConfig())
