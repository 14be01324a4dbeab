"""The reading of a `swarm.toml` into a checked `Config`: the robots, their topology and the relay rules.

The tables of single concerns are in `sections`. Nothing is guessed: an unknown table or entry, a wrong type
or a topology that cannot work is a `ConfigError` naming file, table, entry and what was expected.
"""

import os
import re
import socket
from collections.abc import Sequence
from pathlib import Path

from swarm.config import find, sections
from swarm.config.reader import Table, listed, shown
from swarm.config.toml_input import read_toml
from swarm.config.types import (
    AUTO_LINKS,
    DEFAULT_RELAY,
    GRAPH,
    MAX_RFCOMM_LINKS,
    STAR,
    TREE,
    Config,
    RelayRule,
    RobotConfig,
)
from swarm.core.graph import SHAPES, Graph
from swarm.errors import ConfigError, LocalError, PayloadError
from swarm.messages.keys import MAX_KEY_LENGTH, ROOT, is_name
from swarm.process.paths import MAX_SOCKET_PATH

AUTO = "auto"
"""`topology = "auto"`, in place of the table."""

_TABLES = (
    "network", "robots", "robot", "topology", "mesh", "relay", "anchors", "dwm", "body", "balancing", "apps",
    "recordings", "simulation",
)  # fmt: skip

_NAME = "a name: a lower-case letter, then up to 15 lower-case letters, digits, _ or -"
_NETWORK = re.compile(r"[A-Za-z0-9._-]{1,32}")
HOST = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.:%@-]*")
"""A host as ssh knows it. One that begins with a dash would be an option of ssh."""
HOST_EXAMPLE = "a host as ssh knows it: r0.local or pi@192.168.1.15"
_ADDRESS = re.compile(r"([0-9A-Fa-f]{2}:){5}[0-9A-Fa-f]{2}")
_KEY_CHUNK = re.compile(r"[A-Za-z0-9_.:-]+|\*\*?")
_LINK = "tcp:HOST:PORT, sim:SOCKET or rfcomm:ADDRESS"


def load(path: Path | None = None, *, addressed: bool = True) -> Config:
    """Read the swarm's file: `path`, else the first that is there of `find.places`. Raises `ConfigError`.

    Without `addressed` Bluetooth addresses may be missing: that is how a file begins, `swarm pair` writes them.
    """
    if path is None:
        path = find.find()
    if path is None:
        raise ConfigError(
            f"there is no {find.NAME}: looked in {listed(list(map(str, find.places())))}; name yours in the variable "
            f"SWARM_CONFIG, or start from a commented one: swarm config --example > {find.NAME}"
        )
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        named = ", which the variable SWARM_CONFIG names" if find.is_named() and path in find.places() else ""
        raise ConfigError(
            f"{path}: there is no such file{named}; start from a commented one: swarm config --example > {path.name}"
        ) from None
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: byte {error.start} is not UTF-8, as TOML demands") from None
    except (OSError, ValueError) as error:  # ValueError: a zero byte in the path
        raise ConfigError(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}") from None
    return parse(text, path, addressed=addressed)


def parse(text: str, path: Path, *, addressed: bool = True) -> Config:
    """Check the text of a file; `path` is for the messages. Raises `ConfigError`."""
    try:
        data = read_toml(text)
    except PayloadError as error:
        raise ConfigError(f"{path}: {error}") from None
    top = Table(str(path), "", data, _TABLES)
    network = top.text("network", expected="1 to 32 letters, digits or . _ -", pattern=_NETWORK)
    robots = _robots(top)
    names = tuple(robot.name for robot in robots)
    auto = data.get("topology") == AUTO
    mesh = sections.mesh(top)
    hubs = mesh.links in (STAR, TREE) or (mesh.links == AUTO_LINKS and all(robot.link is None for robot in robots))
    graph = Graph(names, ()) if auto else _topology(top, robots, addressed, hubs=hubs)
    if problem := wrong_links(mesh.links, len(robots), auto=auto):
        raise top.table("mesh", None).error("links", problem)
    if (auto or mesh.links in (STAR, TREE)) and addressed:
        _check_addresses(top, robots, f'topology = "{AUTO}"' if auto else f'links = "{mesh.links}"')
    body, bodies = sections.bodies(top, names)
    balancing, balancings = sections.balancings(top, names)
    return Config(
        path=path,
        network=network,
        robots=robots,
        edges=graph.edges,
        relay=_relay(top),
        anchors=sections.anchors(top),
        mesh=mesh,
        body=body,
        bodies=bodies,
        balancing=balancing,
        balancings=balancings,
        dwm=sections.dwm(top, names),
        apps=sections.apps(top, names),
        packages=sections.packages(top),
        recordings=sections.recordings(top),
        simulation=sections.simulation(top, names),
        auto=auto,
    )


def who_am_i(config: Config) -> str:
    """Return the name of the robot this process belongs to: SWARM_ROBOT, else the host name up to its first dot."""
    name = os.environ.get("SWARM_ROBOT")
    source = "SWARM_ROBOT"
    if not name:
        name, source = socket.gethostname().partition(".")[0], "the host name"
    if name not in config.names:
        raise ConfigError(
            f"{config.path}: {source} is {shown(name)}, none of its robots ({listed(config.names)}); "
            "set the variable SWARM_ROBOT or the host name to the one this machine is"
        )
    return name


def _robots(top: Table) -> tuple[RobotConfig, ...]:
    robots: list[RobotConfig] = []
    taken: dict[str, str] = {}
    tables = top.tables("robots", ("name", "board", "bluetooth", "link", "host", "uwb", "uwb_role", "i2c_clock"))
    if not tables:
        raise top.error("robots", 'missing; expected at least one robot, written [[robots]] with name = "r0"')
    for table in tables:
        robot = _robot(table)
        for key, value in (
            ("name", robot.name),
            ("bluetooth", robot.bluetooth),
            ("link", robot.link),
            ("uwb", robot.uwb),
            ("host", (robot.host or robot.name).rpartition("@")[2].lower()),
        ):
            # The prefix keeps the kinds apart: a robot may be called as another's socket.
            if value is not None and taken.setdefault(f"{key} {value}", robot.name) is not robot.name:
                raise table.error(key, f"{shown(value)} is already that of robot {taken[f'{key} {value}']}")
        robots.append(robot)
    return tuple(robots)


def _robot(table: Table) -> RobotConfig:
    name = table.text("name", expected=_NAME)
    if not is_name(name):
        raise table.wrong("name", _NAME)
    bluetooth = table.text("bluetooth", None, expected="an address like B8:27:EB:12:34:56", pattern=_ADDRESS)
    link = table.text("link", None, expected=_LINK)
    if link is not None:
        kind, _, rest = link.partition(":")
        if kind == "rfcomm" and _ADDRESS.fullmatch(rest):
            # Another way to write `bluetooth`: a robot without any other link is reached by RFCOMM.
            if bluetooth is not None and bluetooth.upper() != rest.upper():
                raise table.error("link", f"{shown(link)} is not the robot's bluetooth address {bluetooth}")
            bluetooth, link = rest, None
        elif not (kind == "tcp" and sections.HOST_PORT.fullmatch(rest) and sections.is_port(rest)) and not (
            kind in ("sim", "slots") and 0 < len(os.fsencode(rest)) <= MAX_SOCKET_PATH
        ):
            raise table.wrong("link", _LINK)
    board = table.choice("board", "zero2w", ("zero2w", "pi4"))
    uwb = sections.uwb_address(table, "uwb") if "uwb" in table else None
    role = table.choice("uwb_role", "tag", ("tag", "anchor"))
    host = table.text("host", None, expected=HOST_EXAMPLE, pattern=HOST)
    if (i2c_clock := table.count("i2c_clock", 100, low=1)) not in (100, 400):
        raise table.wrong("i2c_clock", "100 or 400, in kHz")
    return RobotConfig(name, board, bluetooth.upper() if bluetooth else None, link, host, uwb, role, i2c_clock)


def _topology(top: Table, robots: Sequence[RobotConfig], addressed: bool, *, hubs: bool) -> Graph:
    """`hubs`: its links are not those of the radio."""
    ways = ("shape", "edges", "matrix")
    if isinstance(top.data.get("topology"), str):
        raise top.wrong("topology", f'"{AUTO}" or a table, written [topology]')
    table = top.table("topology", ways)
    names = [robot.name for robot in robots]
    given = [way for way in ways if way in table]
    if len(given) != 1 and (given or len(robots) > 1):
        got = f"got {' and '.join(given)}" if given else "got none"
        raise table.error(None, f"expected exactly one of shape, edges or matrix, {got}")
    way = given[0] if given else "edges"
    try:
        if way == "shape":
            graph = Graph.of_shape(table.text("shape", expected=f"{', '.join(SHAPES[:-1])} or {SHAPES[-1]}"), names)
        elif way == "matrix":
            graph = Graph.of_matrix(_matrix(table), names)
        else:
            graph = Graph(names, _edges(table))
        graph.check_connected()
    except ConfigError:
        raise
    except LocalError as error:
        raise table.error(way, str(error)) from None
    _check_radio(table, way, robots, graph, addressed, hubs=hubs)
    return graph


def _check_radio(
    table: Table, way: str, robots: Sequence[RobotConfig], graph: Graph, addressed: bool, *, hubs: bool
) -> None:
    """Robots without a `link` of their own are reached by RFCOMM: they need an address, and have seven links at most
    where no hubs carry the topology.

    A link counts as RFCOMM when either end has no `link`, since which end dials is not the file's affair.
    """
    radio = {robot.name for robot in robots if robot.link is None}
    for i, robot in enumerate(robots):
        near = graph.neighbours(robot.name)
        if addressed and robot.name in radio and near and robot.bluetooth is None:
            raise Table(table.file, f"robots.{i}", {}, None).error(
                "bluetooth",
                f"{robot.name} has neighbours ({', '.join(near[:8])}) and no link, so Bluetooth reaches it: "
                f'expected its address, like "B8:27:EB:12:34:56" (swarm pair writes it)',
            )
        links = len(near) if robot.name in radio else sum(other in radio for other in near)
        if links > MAX_RFCOMM_LINKS and not hubs:
            raise table.error(
                way,
                f"{robot.name} has {links} RFCOMM links, a Bluetooth radio holds at most {MAX_RFCOMM_LINKS}",
            )


def wrong_links(links: str, robots: int, *, auto: bool) -> str:
    """Return why these links cannot carry a topology; empty where they can."""
    if auto and links not in (GRAPH, AUTO_LINKS):
        return f'topology = "{AUTO}" finds links itself: expected "{GRAPH}", got "{links}"'
    if links == STAR and robots > MAX_RFCOMM_LINKS + 1:
        return f'a hub has at most {MAX_RFCOMM_LINKS} links: expected "{TREE}" for {robots} robots, got "{STAR}"'
    return ""


def _check_addresses(top: Table, robots: Sequence[RobotConfig], way: str) -> None:
    """Raise where a robot has no address although any two robots may have a link, as `way` says."""
    for i, robot in enumerate(robots):
        if robot.link is None and robot.bluetooth is None and len(robots) > 1:
            raise Table(top.file, f"robots.{i}", {}, None).error(
                "bluetooth",
                f"with {way} each robot can be called by any other: expected the address of "
                f'{robot.name}, like "B8:27:EB:12:34:56" (swarm pair writes it), or its link',
            )


def _edges(table: Table) -> list[tuple[str, str]]:
    expected = 'a list of pairs of robots, like [["r0", "r1"], ["r1", "r2"]]'
    edges: list[tuple[str, str]] = []
    value = table.data.get("edges", [])
    if not isinstance(value, list):
        raise table.wrong("edges", expected)
    for pair in value:
        if not isinstance(pair, list) or len(pair) != 2 or not all(isinstance(name, str) for name in pair):
            raise table.error("edges", f"expected {expected}, got the entry {shown(pair)}")
        edges.append((pair[0], pair[1]))
    return edges


def _matrix(table: Table) -> list[list[int]]:
    expected = "a list of rows of 0 and 1, one row for each robot"
    value = table.data["matrix"]
    if not isinstance(value, list):
        raise table.wrong("matrix", expected)
    for row in value:
        if not isinstance(row, list) or not all(type(entry) is int and entry in (0, 1) for entry in row):
            raise table.error("matrix", f"expected {expected}, got the row {shown(row)}")
    return value


def _relay(top: Table) -> tuple[RelayRule, ...]:
    rules = list(DEFAULT_RELAY)
    for table in top.tables("relay", ("keys", "overlay", "priority", "queue", "max_rate")):
        keys = table.text("keys", expected="a key expression like swarm/{self}/dwm/pose")
        overlay = table.choice("overlay", "neighbours", ("neighbours", "flood", "unicast"))
        problem = _wrong_keys(keys, overlay)
        if problem:
            raise table.error("keys", f"{problem}, got {shown(keys)}")
        if any(rule.keys == keys for rule in rules):
            raise table.error("keys", f"there is a rule for {keys} already (the platform's own are added to yours)")
        rule = RelayRule(
            keys,
            overlay=overlay,
            priority=table.choice("priority", "bulk", ("control", "sync", "bulk")),
            queue=table.choice("queue", "latest", ("latest", "all")),
            max_rate=table.number("max_rate", None, above=0, expected="a number above 0, in Hz"),
        )
        if rule.max_rate is not None and rule.queue == "all":
            raise table.error("max_rate", 'only for queue = "latest": "all" may not leave anything out')
        rules.append(rule)
    return tuple(rules)


def _wrong_keys(keys: str, overlay: str) -> str | None:
    """Explain what is wrong with the key expression of a relay rule; None where it is right."""
    chunks = keys.split("/")
    command = overlay == "unicast" and chunks[:2] == [ROOT, "{peer}"]
    if chunks[:2] != [ROOT, "{self}"] and not command:
        commands = f", or unicast commands below {ROOT}/{{peer}}/" if overlay == "unicast" else ""
        return f"expected keys below {ROOT}/{{self}}/ (a robot relays only its own){commands}"
    tail = chunks[2:]
    if len(tail) < 2 and tail != ["**"]:
        return f"expected {ROOT}/{{self}}/SERVICE/TOPIC or {ROOT}/{{self}}/**"
    if overlay == "unicast" and chunks.count("{peer}") != 1:
        return "expected {peer} once: the robot it goes to"
    if overlay == "flood" and "{peer}" in tail:
        return "expected no {peer}: a flood goes to all"
    if tail.count("{peer}") > 1:
        return "expected {peer} at most once"
    if command and "set" not in tail:
        return f"expected a chunk set after {ROOT}/{{peer}}/: only commands travel under the receiver's name"
    if "set" in tail and not command:
        return "expected no chunk set: commands to a robot are not relayed from it"
    for before, chunk in zip(["", *tail], tail, strict=False):
        if chunk != "{peer}" and not _KEY_CHUNK.fullmatch(chunk):
            return f"expected chunks of letters, digits and _ . : - or one of *, **, {{peer}}; {chunk!r} is none"
        if before == "**" and chunk in ("*", "**"):
            return f"expected no {chunk} after **"  # not a canonical key expression: Zenoh refuses it
    if len(keys) + 2 * 16 > MAX_KEY_LENGTH:  # names of robots have up to 16 characters
        return f"expected at most {MAX_KEY_LENGTH - 32} characters"
    return None
