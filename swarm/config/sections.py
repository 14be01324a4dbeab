"""The tables of `swarm.toml` that speak of one concern each: mesh, anchors, dwm, body,
balancing, apps, recordings, simulation."""

import dataclasses
import re
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

from swarm.config.reader import Table, finite, vector
from swarm.config.types import (
    LINKS,
    Affine,
    Anchor,
    AppConfig,
    Balancing,
    Body,
    Dwm,
    Linear,
    MeshConfig,
    Recordings,
    SimulationConfig,
)
from swarm.messages.codec import Value
from swarm.messages.keys import is_key, is_name

T = TypeVar("T")

HOST_PORT = re.compile(r"(?:[A-Za-z0-9._-]+|\[[0-9A-Fa-f:.]+\]):[0-9]{1,5}")
"""A host name, an IPv4 address or an IPv6 address in brackets, then a port."""

FILTERS = ("auto", "ekf", "multilateration", "average")
"""The filters that may estimate a robot's pose."""

_PATH = re.compile(r"/.*")
MAX_CHANNEL = 30
"""RFCOMM has 30 server channels (Bluetooth RFCOMM specification, section 5.4)."""

CONTROLLERS = ("lqr", "pololu", "thesis")
MAX_SPEED = 0.6
MAX_TURN_RATE = 6.0
MAX_ACCELERATION = 1.0
MAX_TURN_ACCELERATION = 20.0
"""The limits up to which driving is tested, in m/s, rad/s, m/s^2 and rad/s^2. Beyond them a robot may fall."""

_UWB_ADDRESS = re.compile(r"[0-9A-Fa-f]{4}")
_PACKAGE = re.compile(r"[A-Za-z0-9](?:[A-Za-z0-9._-]*[A-Za-z0-9])?(?:(?:==|>=|<=|~=|<|>|!=)[A-Za-z0-9.*+!]+,?)*")
_PARAMETER = "a finite number, a 64-bit whole number, true or false, a text or a list of finite numbers"


def is_port(text: str) -> bool:
    """Return whether HOST:PORT ends in a port one can listen at."""
    return 1 <= int(text.rpartition(":")[2]) <= 65535


def mesh(top: Table) -> MeshConfig:
    """Read the table [mesh]."""
    table = top.table(
        "mesh",
        (
            "insecure",
            "key",
            "listen",
            "heartbeat",
            "suspect",
            "dead",
            "handshake",
            "patience",
            "rfcomm_channel",
            "rfcomm_encrypt",
            "metric",
            "links",
        ),
    )
    normal = MeshConfig()
    seconds = "a number above 0, in seconds"
    listen = table.text("listen", None, expected="HOST:PORT", pattern=HOST_PORT)
    if listen is not None and not is_port(listen):
        raise table.wrong("listen", "HOST:PORT with a port from 1 to 65535")
    found = MeshConfig(
        insecure=table.flag("insecure", normal.insecure),
        key=table.text("key", None, expected="the whole path of a file made by `swarm key new`", pattern=_PATH),
        listen=listen,
        heartbeat=table.number("heartbeat", normal.heartbeat, above=0, expected=seconds),
        suspect=table.number("suspect", normal.suspect, above=0, expected=seconds),
        dead=table.number("dead", normal.dead, above=0, expected=seconds),
        handshake=table.number("handshake", normal.handshake, above=0, expected=seconds),
        patience=table.number("patience", normal.patience, above=0, expected=seconds),
        metric=table.choice("metric", normal.metric, ("hops", "time")),
        links=table.choice("links", normal.links, LINKS),
        rfcomm_channel=table.count("rfcomm_channel", normal.rfcomm_channel, low=1),
        rfcomm_encrypt=table.flag("rfcomm_encrypt", normal.rfcomm_encrypt),
    )
    if found.insecure and found.key is not None:
        raise table.error("key", "expected either a key or insecure = true: links with and without never mix")
    if found.rfcomm_channel > MAX_CHANNEL:
        raise table.wrong("rfcomm_channel", f"a channel from 1 to {MAX_CHANNEL}")
    if not found.heartbeat < found.suspect < found.dead <= found.patience:
        raise table.error(
            None,
            f"expected heartbeat < suspect < dead, and patience no less, got {found.heartbeat}, {found.suspect}, "
            f"{found.dead} and {found.patience} s",
        )
    return found


def anchors(top: Table) -> tuple[Anchor, ...]:
    """Read the tables [[anchors]]."""
    found: list[Anchor] = []
    for table in top.tables("anchors", ("address", "x", "y", "z")):
        address = uwb_address(table, "address")
        if any(anchor.address == address for anchor in found):
            raise table.error("address", f"{address} is already that of another anchor")
        x, y = (table.number(key, expected="a finite number, in m") for key in ("x", "y"))
        found.append(Anchor(address, x, y, table.number("z", 0.0, expected="a finite number, in m")))
    return tuple(found)


def dwm(top: Table, robots: Sequence[str]) -> Dwm:
    """Read the table [dwm]."""
    table = top.table(
        "dwm",
        (
            "source",
            "target",
            "rate",
            "filter",
            "filters",
            "window",
            "position_window",
            "latency",
            "height",
            "lever",
            "calibration",
            "distance",
            "position",
        ),
    )
    normal = Dwm()
    expected = "serial:PATH, balancer, bus:KEY or replay:DIR, {robot} in it standing for the robot's name"
    source = table.text("source", normal.source, expected=expected)
    kind, _, place = source.partition(":")
    named = kind in ("serial", "replay", "bus") and place and not set("{}") & set(place.replace("{robot}", ""))
    if source != "balancer" and (not named or (kind == "bus" and not is_key(place.replace("{robot}", "r0")))):
        raise table.wrong("source", expected)
    calibration = table.text("calibration", None, expected="the path of a file, {robot} standing for the robot's name")
    if calibration is not None and set("{}") & set(calibration.replace("{robot}", "")):
        raise table.wrong("calibration", "the path of a file, {robot} standing for the robot's name")
    filters = table.table("filters", robots)
    metres = "a finite number, in m"
    distance = table.table("distance", ("gain", "offset"))
    gain = distance.number("gain", normal.distance.gain, above=0, expected="a number above 0")
    offset = distance.number("offset", normal.distance.offset, expected="a finite number, in m")
    position = table.table("position", ("matrix", "offset"))
    return Dwm(
        source=source,
        target=uwb_address(table, "target") if "target" in table else None,
        rate=table.number("rate", normal.rate, above=0, up_to=10, expected="a number above 0 up to 10, in Hz"),
        filter=table.choice("filter", normal.filter, FILTERS),
        filters={robot: filters.choice(robot, "", FILTERS) for robot in filters.data},
        window=table.count("window", normal.window, low=1),
        position_window=table.count("position_window", 1, low=1) if "position_window" in table else None,
        latency=table.number("latency", normal.latency, above=-1e-9, up_to=0.4, expected="0 to 0.4, in s"),
        height=table.number("height", normal.height, expected=metres),
        lever=table.number("lever", normal.lever, expected=metres),
        calibration=calibration,
        distance=Linear(gain, offset),
        position=Affine(
            _matrix(position, normal.position.matrix),
            position.numbers("offset", normal.position.offset, expected="two numbers [x, y], in m", length=2),
        ),
    )


def _of_robots(
    top: Table, section: str, robots: Sequence[str], normal: T, read: Callable[[Table, T], T]
) -> tuple[T, dict[str, T]]:
    """Read the settings for all robots, and those of each robot that has a table of its own."""
    names = [field.name for field in dataclasses.fields(normal)]  # type: ignore[arg-type]
    table = top.table(section, (*names, "robots"))
    common = read(table, normal)
    single = table.table("robots", robots)
    return common, {robot: read(single.table(robot, names), common) for robot in single.data}


def bodies(top: Table, robots: Sequence[str]) -> tuple[Body, dict[str, Body]]:
    """Return the table [body] and, on top of it, [body.robots.ROBOT]."""
    return _of_robots(top, "body", robots, Body(), _body)


def _body(table: Table, normal: Body) -> Body:
    trim = table.number("trim", normal.trim, expected="an angle within 0.5 of 0, in rad")
    if abs(trim) > 0.5:
        raise table.wrong("trim", "an angle within 0.5 of 0, in rad")
    length, weight = "a number above 0, in m", "a number above 0 up to 1, in kg"
    return Body(
        wheel_radius=table.number("wheel_radius", normal.wheel_radius, above=0, expected=length),
        gear_ratio=table.number("gear_ratio", normal.gear_ratio, above=0, expected="a number above 0"),
        track=table.number("track", normal.track, above=0, expected=length),
        trim=trim,
        payload=table.number("payload", normal.payload, above=0, up_to=1, expected=weight),
        payload_height=table.number("payload_height", normal.payload_height, above=0, expected=length),
    )


def balancings(top: Table, robots: Sequence[str]) -> tuple[Balancing, dict[str, Balancing]]:
    """Return the table [balancing] and, on top of it, [balancing.robots.ROBOT]."""
    return _of_robots(top, "balancing", robots, Balancing(), _balancing)


def _balancing(table: Table, normal: Balancing) -> Balancing:
    def up_to(name: str, limit: float, unit: str) -> float:
        expected = f"a number above 0 up to {limit:g}, in {unit}"
        number: float = table.number(name, getattr(normal, name), above=0, up_to=limit, expected=expected)
        return number

    found = Balancing(
        controller=table.choice("controller", normal.controller, CONTROLLERS),
        max_speed=up_to("max_speed", MAX_SPEED, "m/s"),
        max_turn_rate=up_to("max_turn_rate", MAX_TURN_RATE, "rad/s"),
        acceleration=up_to("acceleration", MAX_ACCELERATION, "m/s^2"),
        turn_acceleration=up_to("turn_acceleration", MAX_TURN_ACCELERATION, "rad/s^2"),
        battery_warning=up_to("battery_warning", 20.0, "V"),
        battery_limit=up_to("battery_limit", 20.0, "V"),
        flip_left_motor=table.flag("flip_left_motor", normal.flip_left_motor),
        flip_right_motor=table.flag("flip_right_motor", normal.flip_right_motor),
    )
    if not found.battery_limit < found.battery_warning:
        raise table.error(
            "battery_limit",
            f"expected less than battery_warning, got {found.battery_limit:g} and {found.battery_warning:g} V",
        )
    return found


def apps(top: Table, robots: Sequence[str]) -> dict[str, AppConfig]:
    """Return the tables [apps.NAME] and, on top of them, [apps.NAME.robots.ROBOT]."""
    found: dict[str, AppConfig] = {}
    every = top.table("apps", None)
    for name in every.data:
        if not is_name(name):
            raise every.error(name, "expected the name of an app: a lower-case letter, then letters, digits, _ or -")
        table = every.table(name, None)
        single = table.table("robots", robots)
        found[name] = AppConfig(
            {key: _parameter(table, key) for key in table.data if key != "robots"},
            {robot: _parameters(single.table(robot, None)) for robot in single.data},
        )
    return found


def recordings(top: Table) -> Recordings:
    """Read the table [recordings]."""
    table = top.table("recordings", ("budget",))
    normal = Recordings()
    return Recordings(table.number("budget", normal.budget, above=0, expected="a number above 0, in bytes"))


def packages(top: Table) -> tuple[str, ...]:
    """Return the table [robot]: Python packages for all robots."""
    table = top.table("robot", ("packages",))
    expected = 'a list of packages as pip names them, like ["numpy", "scipy==1.16.0"]'
    found = table.data.get("packages", [])
    if not isinstance(found, list) or not all(isinstance(each, str) and _PACKAGE.fullmatch(each) for each in found):
        raise table.wrong("packages", expected)
    return tuple(dict.fromkeys(found))


def simulation(top: Table, robots: Sequence[str]) -> SimulationConfig:
    """Read the table [simulation]."""
    parts = ("scl", "battery", "gyro_noise", "acceleration_noise", "range_noise")
    table = top.table("simulation", ("target", "target_velocity", "places", *parts))
    normal = SimulationConfig()
    places = table.table("places", robots)
    expected = "three numbers [x, y, heading], in m, m and rad"
    return SimulationConfig(
        target=table.numbers("target", normal.target, expected="two numbers [x, y], in m", length=2),
        target_velocity=table.numbers(
            "target_velocity", normal.target_velocity, expected="two numbers [vx, vy], in m/s", length=2
        ),
        places={robot: places.numbers(robot, (), expected=expected, length=3) for robot in places.data},
        scl=table.number("scl", None, above=1e4, up_to=1e6, expected="a clock above 10 kHz, in Hz, at most 1 MHz"),
        battery=table.number("battery", None, above=0, up_to=12, expected="a voltage above 0, in V, at most 12"),
        gyro_noise=table.number("gyro_noise", None, above=0, up_to=1, expected="a deviation in rad/s, at most 1"),
        acceleration_noise=table.number(
            "acceleration_noise", None, above=0, up_to=10, expected="a deviation in m/s^2, at most 10"
        ),
        range_noise=table.number("range_noise", None, above=0, up_to=10, expected="a deviation in m, at most 10"),
    )


def uwb_address(table: Table, key: str) -> str:
    """Return the short address of a DWM1001."""
    address: str = table.text(key, expected="four hex digits like C933", pattern=_UWB_ADDRESS)
    return address.upper()


def _matrix(table: Table, default: tuple[tuple[float, float], tuple[float, float]]) -> Any:
    if "matrix" not in table:
        return default
    value = table.data["matrix"]
    rows = [vector(row) for row in value] if isinstance(value, list) else []
    if len(rows) != 2 or not all(row is not None and len(row) == 2 for row in rows):
        raise table.wrong("matrix", "two rows of two numbers, [[a, b], [c, d]]")
    return tuple(rows)


def _parameters(table: Table) -> dict[str, Value]:
    return {key: _parameter(table, key) for key in table.data}


def _parameter(table: Table, key: str) -> Value:
    if not key.isidentifier() or key.startswith("_"):
        raise table.error(key, "expected a parameter's name: letters, digits and _, not starting with a digit or _")
    value = table.data[key]
    if isinstance(value, (bool, str)):
        return value
    if isinstance(value, int) and -(2**63) <= value < 2**63:
        return value
    if isinstance(value, list):
        if (numbers := _numbers_in(value)) is not None:
            return numbers
    elif isinstance(value, float) and finite(value) is not None:
        return value
    raise table.wrong(key, _PARAMETER)


def _numbers_in(values: list[Any]) -> tuple[float, ...] | None:
    """Return the numbers of a list, of nested lists row by row; None where there is anything else, or rows are of
    different lengths."""
    if (numbers := vector(values)) is not None:
        return numbers
    rows = [_numbers_in(row) if isinstance(row, list) else None for row in values]
    known = [row for row in rows if row is not None]
    if len(known) < len(rows) or len({*map(len, known)}) > 1:
        return None
    return tuple([number for row in known for number in row])
