"""swarm.toml: what a right file means, what every wrong one is told, and that nothing else ever comes out."""

import dataclasses
import math
import re
import socket
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from swarm import config as configuration
from swarm.config import (
    DEFAULT_RELAY,
    Affine,
    Anchor,
    AppConfig,
    Balancing,
    Body,
    Config,
    Dwm,
    Linear,
    MeshConfig,
    RelayRule,
    RobotConfig,
    SimulationConfig,
    dump,
    find,
    load,
    parse,
    types,
    who_am_i,
)
from swarm.config.example import EXAMPLE
from swarm.config.sections import FILTERS
from swarm.core.graph import Graph
from swarm.errors import ConfigError, LocalError

FILE = Path("swarm.toml")

THREE = """\
network = "lab"
[[robots]]
name = "r0"
link = "tcp:10.0.0.1:7447"
[[robots]]
name = "r1"
link = "tcp:10.0.0.2:7447"
[[robots]]
name = "r2"
link = "tcp:10.0.0.3:7447"
[topology]
shape = "line"
[mesh]
insecure = true
"""

ONE = 'network = "lab"\n[[robots]]\nname = "r0"\n'


def radio(count, topology):
    robots = "".join(f'[[robots]]\nname = "r{i}"\nbluetooth = "B8:27:EB:00:00:{i:02X}"\n' for i in range(count))
    return f'network = "lab"\n{robots}[topology]\n{topology}\n[mesh]\ninsecure = true\n'


def swap(old, new, text=THREE):
    assert old in text
    return text.replace(old, new)


def test_a_file_with_little_in_it():
    config = parse(THREE, FILE)
    assert config == Config(
        path=FILE,
        network="lab",
        robots=tuple(RobotConfig(f"r{i}", link=f"tcp:10.0.0.{i + 1}:7447") for i in range(3)),
        edges=(("r0", "r1"), ("r1", "r2")),
        relay=DEFAULT_RELAY,
        mesh=MeshConfig(insecure=True),
    )
    assert config.neighbours("r1") == ("r0", "r2")


def test_one_robot_alone_needs_nothing():
    config = parse(ONE, FILE)
    assert config.edges == ()
    assert config.robots == (RobotConfig("r0"),)


def test_the_example_is_right():
    config = parse(EXAMPLE, FILE)
    assert config.names == ("r0", "r1", "r2", "r3", "r4", "r5")
    assert config.edges == Graph.of_shape("thesis-d", config.names).edges
    assert config.dwm.distance == Linear(0.946976, -0.05964849)
    assert config.dwm.position == Affine(
        ((0.93538932, 0.00353817), (-0.01071457, 0.94470965)), (0.046239576, 0.050861534)
    )
    assert [(a.x, a.y) for a in config.anchors] == [(0, 0), (1.94, 0), (1, 1.94)]
    assert config.dwm.target == "C933"
    assert config.app("consensus").of("r5") == {"algorithm": "metropolis", "value": 5.0}
    assert config.app("consensus").of("r0") == {"algorithm": "metropolis", "value": 0.5}
    assert config.relay[: len(DEFAULT_RELAY)] == DEFAULT_RELAY
    assert config.relay[len(DEFAULT_RELAY)] == RelayRule("swarm/{self}/dwm/pose", max_rate=2.0)
    assert max(map(len, EXAMPLE.splitlines())) <= 110


def test_the_example_says_the_defaults():
    config = parse(EXAMPLE, FILE)
    assert config.mesh == MeshConfig()
    assert str(config.mesh.key_file) in EXAMPLE
    assert config.body == Body()
    assert config.balancing == Balancing()
    assert config.body_of("r4") == Body(trim=0.03)
    assert config.balancing_of("r5") == Balancing(controller="pololu")
    assert (config.body_of("r0"), config.balancing_of("r0")) == (Body(), Balancing())
    own = {"target": None, "distance": Linear(), "position": Affine(), "filters": {}, "position_window": None}
    own["calibration"] = None
    assert config.dwm.position_window == config.dwm.window
    assert dataclasses.replace(config.dwm, **own) == Dwm()


# `path` is no entry; `parameters` are an app's own entries; edges are written as [topology].
NOT_ENTRIES = {
    (Config, "path"),
    (AppConfig, "parameters"),
    (Config, "bodies"),
    (Config, "balancings"),
    (Config, "auto"),
}


@pytest.mark.parametrize(
    ("kind", "field"),
    [
        (kind, field.name)
        for kind in vars(types).values()
        if isinstance(kind, type) and dataclasses.is_dataclass(kind)
        for field in dataclasses.fields(kind)
        if (kind, field.name) not in NOT_ENTRIES
    ],
)
def test_the_example_mentions_every_entry(kind, field):
    assert re.search(rf"^#? ?{field} = |^\[+([a-z.0-9]+\.)?{field}[].]", EXAMPLE, re.MULTILINE)


def test_what_the_example_leaves_out_is_right_too():
    """Each commented entry, put in place of what it stands for."""
    lines = EXAMPLE.splitlines()
    start = next(i for i, line in enumerate(lines) if line.startswith("# matrix = "))
    end = next(i for i in range(start, len(lines)) if lines[i] == "# ]")
    matrix = "\n".join(line[2:] for line in lines[start : end + 1])
    auto = next(line[2:] for line in lines if line.startswith("# topology = "))
    table = EXAMPLE[EXAMPLE.index("\n[topology]\n") : EXAMPLE.index("# ---- Mesh")]
    alone = parse(EXAMPLE.replace(table, "").replace(f"# {auto}", auto), FILE)
    assert alone.auto
    assert alone.edges == ()
    edges = next(line[2:] for line in lines if line.startswith("# edges = "))
    shape = next(line for line in lines if line.startswith("shape = "))
    assert parse(EXAMPLE.replace(shape, matrix), FILE).edges == parse(EXAMPLE, FILE).edges
    assert len(parse(EXAMPLE.replace(shape, edges), FILE).edges) == 5
    assert parse(EXAMPLE.replace("# link = ", "link = "), FILE).robot("r5").link == "tcp:192.168.1.15:7447"
    assert parse(EXAMPLE.replace("# listen = ", "listen = "), FILE).mesh.listen == "0.0.0.0:7447"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        # The whole file.
        ("", "network: missing; expected 1 to 32 letters, digits or . _ -"),
        ("a = ", "not valid TOML: Invalid value (at end of document)"),
        ('network = "x"\nrobots = [', "not valid TOML: Invalid value (at end of document)"),
        ('network = "x"\nnetwork = "y"', "not valid TOML: Cannot overwrite a value (at "),
        ("x = " + "[" * 5000, "not valid TOML: nested too deeply"),
        ("x = " + "9" * 5000, "not valid TOML: Exceeds the limit"),
        (swap('"lab"', '"my lab"'), "network: expected 1 to 32 letters, digits or . _ -, got 'my lab'"),
        (swap('"lab"', "7"), "network: expected 1 to 32 letters, digits or . _ -, got 7"),
        (THREE + "[mseh]\ndead = 3", "[mseh]: unknown table; did you mean mesh?"),
        ("colour = 1\n" + THREE, "colour: unknown entry; expected one of network, robots,"),
        ('"" = 1\n' + THREE, "'': unknown entry; expected one of network, robots,"),
        (THREE + "[[anchor]]\nx = 1", "[anchor]: unknown table; did you mean anchors?"),
        ("mesh = 3\n" + swap("[mesh]\ninsecure = true", ""), "mesh: expected a table, written [mesh], got 3"),
        # Robots.
        ('network = "lab"', 'robots: missing; expected at least one robot, written [[robots]] with name = "r0"'),
        ('network = "lab"\n[robots]\na = 1', "robots: expected a list of tables, each written [[robots]], got a table"),
        ('network = "lab"\nrobots = ["r0"]', "robots: expected a list of tables, each written [[robots]], got ['r0']"),
        (swap('name = "r1"', ""), "[robots.1] name: missing; expected a name: a lower-case letter"),
        (swap('"r1"', '"R1"'), "[robots.1] name: expected a name: a lower-case letter"),
        (swap('"r1"', '"r0"'), "[robots.1] name: 'r0' is already that of robot r0"),
        (swap('"r1"', '"r1"\nboard = "pi5"'), "[robots.1] board: expected zero2w or pi4, got 'pi5'"),
        (swap('"r1"', '"r1"\nbaord = "pi4"'), "[robots.1] baord: unknown entry; did you mean board?"),
        (swap('"r1"', '"r1"\nbluetooth = "B8:27"'), "[robots.1] bluetooth: expected an address like B8:27:EB:12:34:56"),
        (
            radio(2, 'shape = "line"').replace(":01", ":00"),
            "[robots.1] bluetooth: 'B8:27:EB:00:00:00' is already that of robot r0",
        ),
        (
            swap("tcp:10.0.0.3:7447", "foo"),
            "[robots.2] link: expected tcp:HOST:PORT, sim:SOCKET or rfcomm:ADDRESS, got 'foo'",
        ),
        (swap("10.0.0.3:7447", "10.0.0.3"), "[robots.2] link: expected tcp:HOST:PORT"),
        (swap("10.0.0.3:7447", "10.0.0.3:0"), "[robots.2] link: expected tcp:HOST:PORT"),
        (swap("10.0.0.3:7447", "10.0.0.3:70000"), "[robots.2] link: expected tcp:HOST:PORT"),
        (swap("tcp:10.0.0.3:7447", "sim:"), "[robots.2] link: expected tcp:HOST:PORT"),
        (swap("tcp:10.0.0.3:7447", "sim:/" + "x" * 107), "[robots.2] link: expected tcp:HOST:PORT"),
        (swap("tcp:10.0.0.3:7447", "sim:/a\\u0000b"), "[robots.2] link: expected tcp:HOST:PORT"),
        (swap("tcp:10.0.0.3:7447", "rfcomm:B8"), "[robots.2] link: expected tcp:HOST:PORT"),
        (swap('"r0"', '"r0"\nuwb_role = "beacon"'), "[robots.0] uwb_role: expected tag or anchor, got 'beacon'"),
        (swap('"r0"', '"r0"\ni2c_clock = 200'), "[robots.0] i2c_clock: expected 100 or 400, in kHz, got 200"),
        (
            swap('"r1"', '"r1"\nuwb = "DE01"').replace('"r0"', '"r0"\nuwb = "de01"', 1),
            "[robots.1] uwb: 'DE01' is already that of robot r0",
        ),
        (swap("10.0.0.3", "10.0.0.2"), "[robots.2] link: 'tcp:10.0.0.2:7447' is already that of robot r1"),
        (
            swap('link = "tcp:10.0.0.3:7447"', 'link = "rfcomm:00:00:00:00:00:01"\nbluetooth = "00:00:00:00:00:02"'),
            "[robots.2] link: 'rfcomm:00:00:00:00:00:01' is not the robot's bluetooth address 00:00:00:00:00:02",
        ),
        (
            swap('link = "tcp:10.0.0.2:7447"', ""),
            "[robots.1] bluetooth: r1 has neighbours (r0, r2) and no link, so Bluetooth reaches it: expected its",
        ),
        # Topology.
        (swap('shape = "line"', ""), "[topology]: expected exactly one of shape, edges or matrix, got none"),
        (
            swap('shape = "line"', 'shape = "line"\nedges = []'),
            "[topology]: expected exactly one of shape, edges or matrix, got shape and edges",
        ),
        (
            swap('"line"', '"star"'),
            "[topology] shape: expected line, loop, full, thesis-d or random:SEED, got 'star'",
        ),
        (swap('"line"', "3"), "[topology] shape: expected line, loop, full, thesis-d or random:SEED, got 3"),
        (swap('"line"', '"thesis-d"'), "[topology] shape: thesis-d is a graph of six robots, here are 3"),
        (swap('shape = "line"', 'edges = "r0-r1"'), "[topology] edges: expected a list of pairs of robots"),
        (
            swap('shape = "line"', 'edges = [["r0", "r1"], ["r2"]]'),
            '[topology] edges: expected a list of pairs of robots, like [["r0", "r1"], ["r1", "r2"]], '
            "got the entry ['r2']",
        ),
        (swap('shape = "line"', 'edges = [["r0", 1]]'), "[topology] edges: expected a list of pairs of robots"),
        (swap('shape = "line"', 'edges = [["r0", "r9"]]'), "[topology] edges: link r0-r9: there is no robot 'r9'"),
        (swap('shape = "line"', 'edges = [["r0", "r0"]]'), "[topology] edges: link r0-r0: a robot is not linked to"),
        (
            swap('shape = "line"', 'edges = [["r0", "r1"]]'),
            "[topology] edges: not connected: these parts cannot reach each other: r0 r1; r2",
        ),
        (
            swap('shape = "line"', "matrix = [[0, 1, 0], [0, 0, 1], [0, 1, 0]]"),
            "[topology] matrix: not symmetric: row of r0, column of r1 is 1",
        ),
        (swap('shape = "line"', "matrix = [[0, true]]"), "[topology] matrix: expected a list of rows of 0 and 1"),
        (swap('shape = "line"', "matrix = [0, 1]"), "[topology] matrix: expected a list of rows of 0 and 1"),
        (swap('shape = "line"', "matrix = 1"), "[topology] matrix: expected a list of rows of 0 and 1"),
        (
            radio(9, 'shape = "full"'),
            "[topology] shape: r0 has 8 RFCOMM links, a Bluetooth radio holds at most 7",
        ),
        # Mesh.
        (THREE + 'key = "/etc/swarm/key"', "[mesh] key: expected either a key or insecure = true"),
        (swap("insecure = true", 'key = "key"'), "[mesh] key: expected the whole path of a file made by `swarm key"),
        (swap("insecure = true", "insecure = 1"), "[mesh] insecure: expected true or false, got 1"),
        (
            THREE + "dead = 1",
            "[mesh]: expected heartbeat < suspect < dead, and patience no less, got 0.5, 1.5, 1.0 and 60.0 s",
        ),
        (THREE + "dead = 0", "[mesh] dead: expected a number above 0, in seconds, got 0"),
        (THREE + "dead = inf", "[mesh] dead: expected a number above 0, in seconds, got inf"),
        (THREE + "dead = nan", "[mesh] dead: expected a number above 0, in seconds, got nan"),
        (THREE + "dead = true", "[mesh] dead: expected a number above 0, in seconds, got true"),
        (THREE + 'listen = "7447"', "[mesh] listen: expected HOST:PORT, got '7447'"),
        (THREE + 'listen = "a:99999"', "[mesh] listen: expected HOST:PORT with a port from 1 to 65535"),
        # Relay.
        (THREE + "[[relay]]", "[relay.0] keys: missing; expected a key expression like swarm/{self}/dwm/pose"),
        *(
            (THREE + f'[[relay]]\nkeys = "{keys}"', f"[relay.0] keys: {message}")
            for keys, message in [
                ("swarm/r0/dwm/pose", "expected keys below swarm/{self}/ (a robot relays only its own), got 'swarm/r0"),
                ("swarm/*/dwm/pose", "expected keys below swarm/{self}/"),
                ("swarm/stop", "expected keys below swarm/{self}/"),
                ("**", "expected keys below swarm/{self}/"),
                ("swarm/{self}/dwm", "expected swarm/{self}/SERVICE/TOPIC or swarm/{self}/**"),
                ("swarm/{self}/a/{peer}/{peer}", "expected {peer} at most once"),
                ("swarm/{self}/a/x{peer}", "expected chunks of letters"),
                ("swarm/{self}/a/b$*", "expected chunks of letters"),
                ("swarm/{self}/a//b", "expected chunks of letters, digits and _ . : - or one of *, **, {peer}; ''"),
                ("swarm/{self}/a/b/", "expected chunks of letters"),
                ("swarm/{self}/{self}/b", "expected chunks of letters"),
                ("swarm/{self}/**/**", "expected no ** after **"),
                ("swarm/{self}/**/*", "expected no * after **"),
                ("swarm/{self}/balancer/set/mode", "expected no chunk set: commands"),
                ("swarm/{self}/a/" + "b" * 300, "expected at most 223 characters"),
                ("swarm/{self}/app/*/sync/*", "there is a rule for swarm/{self}/app/*/sync/* already"),
            ]
        ),
        *(
            (THREE + f'[[relay]]\nkeys = "swarm/{{self}}/dwm/pose"\n{entry}', f"[relay.0] {message}")
            for entry, message in [
                ('overlay = "air"', "overlay: expected neighbours or flood or unicast, got 'air'"),
                ('priority = "high"', "priority: expected control or sync or bulk, got 'high'"),
                ('queue = "last"', "queue: expected latest or all, got 'last'"),
                ("max_rate = 0", "max_rate: expected a number above 0, in Hz, got 0"),
                ('queue = "all"\nmax_rate = 1', 'max_rate: only for queue = "latest"'),
                ("rate = 1", "rate: unknown entry; did you mean max_rate?"),
            ]
        ),
        # Anchors and dwm.
        (ONE + '[[anchors]]\naddress = "C9"\nx = 0\ny = 0', "[anchors.0] address: expected four hex digits like C933"),
        (ONE + '[[anchors]]\naddress = "C933"\nx = 0', "[anchors.0] y: missing; expected a finite number, in m"),
        (
            ONE + '[[anchors]]\naddress = "C933"\nx = inf\ny = 0',
            "[anchors.0] x: expected a finite number, in m, got inf",
        ),
        (
            ONE + "".join(f'[[anchors]]\naddress = "{a}"\nx = 0\ny = 0\n' for a in ("c933", "C933")),
            "[anchors.1] address: C933 is already that of another anchor",
        ),
        *(
            (ONE + f"[dwm]\n{entry}", f"[dwm{message}")
            for entry, message in [
                ('filter = "kalman"', "] filter: expected auto or ekf or multilateration or average, got 'kalman'"),
                ('calibration = "{r}.toml"', "] calibration: expected the path of a file, {robot} standing for"),
                ("latency = 1.0", "] latency: expected 0 to 0.4, in s, got 1.0"),
                ('filters = { r9 = "ekf" }', ".filters] r9: unknown entry"),
                ("windw = 3", "] windw: unknown entry; did you mean window?"),
                ("window = 0", "] window: expected a whole number, at least 1, got 0"),
                ("window = true", "] window: expected a whole number, at least 1, got true"),
                ("window = 2.0", "] window: expected a whole number, at least 1, got 2.0"),
                (
                    "window = 99999999999999999999",
                    "] window: expected a whole number, at least 1, got a number of more",
                ),
                ("rate = 10.5", "] rate: expected a number above 0 up to 10, in Hz, got 10.5"),
                ("rate = 1979-05-27", "] rate: expected a number above 0 up to 10, in Hz, got datetime.date("),
                ('source = "usb:0"', "] source: expected serial:PATH, balancer, bus:KEY or replay:DIR, {robot} in it"),
                ('source = "replay:"', "] source: expected serial:PATH, balancer, bus:KEY or replay:DIR"),
                ('source = "replay:/x/{name}"', "] source: expected serial:PATH, balancer, bus:KEY or replay:DIR"),
                ('target = "ZZZZ"', "] target: expected four hex digits like C933, got 'ZZZZ'"),
                ("distance = 1.0", "] distance: expected a table, written [dwm.distance], got 1.0"),
                ("distance = {gain = 0}", ".distance] gain: expected a number above 0, got 0"),
                ("distance = {gian = 1}", ".distance] gian: unknown entry; did you mean gain?"),
                ("distance = {x = 1}", ".distance] x: unknown entry; expected gain or offset"),
                (
                    "position = {offset = [1, 2, 3]}",
                    ".position] offset: expected two numbers [x, y], in m, got [1, 2, 3]",
                ),
                (
                    "position = {offset = [1, true]}",
                    ".position] offset: expected two numbers [x, y], in m, got [1, true]",
                ),
                ("position = {matrix = [1, 2]}", ".position] matrix: expected two rows of two numbers"),
                ("position = {matrix = [[1, 2], [3]]}", ".position] matrix: expected two rows of two numbers"),
                ("position = {matrix = [[1, 2], [3, nan]]}", ".position] matrix: expected two rows of two numbers"),
            ]
        ),
        # Body, apps, simulation.
        (ONE + "[body]\nwheel_radius = -1", "[body] wheel_radius: expected a number above 0, in m, got -1"),
        (ONE + "[body]\ntrim = 5", "[body] trim: expected an angle within 0.5 of 0, in rad, got 5"),
        (ONE + "[body.robots.r0]\ntrack = 0", "[body.robots.r0] track: expected a number above 0, in m, got 0"),
        (ONE + "[body.robots.r9]\ntrack = 0.1", "[body.robots.r9]: unknown table; "),
        (ONE + "[body]\npayload = 2", "[body] payload: expected a number above 0 up to 1, in kg, got 2"),
        (
            ONE + "[balancing]\ncontroller = 'pid'",
            "[balancing] controller: expected lqr or pololu or thesis, got 'pid'",
        ),
        (
            ONE + "[balancing]\nmax_speed = 3",
            "[balancing] max_speed: expected a number above 0 up to 0.6, in m/s, got 3",
        ),
        (
            ONE + "[balancing.robots.r0]\nbattery_limit = 7",
            "[balancing.robots.r0] battery_limit: expected less than battery_warning, got 7 and 6.6 V",
        ),
        (ONE + "[apps]\nx = 3", "[apps] x: expected a table, written [apps.x], got 3"),
        (ONE + "[apps.Max]", "[apps] Max: expected the name of an app"),
        (ONE + "[apps.max]\n_x = 1", "[apps.max] _x: expected a parameter's name"),
        (ONE + '[apps.max]\n"a b" = 1', "[apps.max] 'a b': expected a parameter's name"),
        (ONE + "[apps.max]\nx = {}", "[apps.max] x: expected a finite number, a 64-bit whole number, true or false"),
        (ONE + "[apps.max]\nx = nan", "[apps.max] x: expected a finite number"),
        (ONE + "[apps.max]\nx = 10000000000000000000", "[apps.max] x: expected a finite number, a 64-bit whole"),
        (ONE + '[apps.max]\nx = [1, "a"]', "[apps.max] x: expected a finite number"),
        (ONE + "[apps.max.robots.r1]\nx = 1", "[apps.max.robots.r1]: unknown table; expected r0"),
        (ONE + "[apps.max.robots]\nr0 = 1", "[apps.max.robots] r0: expected a table, written [apps.max.robots.r0]"),
        (ONE + "[simulation]\ntarget = [1]", "[simulation] target: expected two numbers [x, y], in m, got [1]"),
        (ONE + "[simulation.places]\nr1 = [1, 1, 0]", "[simulation.places] r1: unknown entry; expected r0"),
        (ONE + "[simulation.places]\nr0 = [1, 1]", "[simulation.places] r0: expected three numbers [x, y, heading]"),
    ],
)
def test_wrong_entries(text, message):
    with pytest.raises(ConfigError) as caught:
        parse(text, FILE)
    assert str(caught.value).startswith(f"swarm.toml: {message}")
    assert len(str(caught.value)) < 300
    assert "\n" not in str(caught.value)


def test_seven_radio_links_are_the_limit_only_where_radio_is_used():
    assert len(parse(radio(8, 'shape = "full"'), FILE).edges) == 28
    text = 'network = "lab"\n' + "".join(
        f'[[robots]]\nname = "r{i}"\nlink = "tcp:localhost:{7000 + i}"\n' for i in range(12)
    )
    text += '[topology]\nshape = "full"\n[mesh]\ninsecure = true\n'
    assert len(parse(text, FILE).edges) == 66
    # A robot on Wi-Fi is not limited by its own links, but each of its links to a radio-only robot counts.
    mixed = radio(9, "edges = [" + ",".join(f'["r0", "r{i}"]' for i in range(1, 9)) + "]")
    mixed = mixed.replace('bluetooth = "B8:27:EB:00:00:00"', 'link = "tcp:localhost:7000"')
    with pytest.raises(ConfigError, match="r0 has 8 RFCOMM links"):
        parse(mixed, FILE)


def test_rfcomm_link_is_another_way_to_write_bluetooth():
    text = swap('link = "tcp:10.0.0.3:7447"', 'link = "rfcomm:b8:27:eb:00:00:01"')
    assert parse(text, FILE).robot("r2") == RobotConfig("r2", bluetooth="B8:27:EB:00:00:01")


def test_whole_numbers_stay_whole_in_apps_and_become_floats_elsewhere():
    config = parse(ONE + "[apps.a]\ni = 3\nf = 3.0\nv = [1, 2]\nb = true\nt = ''\n[body]\ntrim = 0", FILE)
    values = config.app("a").of("r0")
    assert values == {"i": 3, "f": 3.0, "v": (1.0, 2.0), "b": True, "t": ""}
    assert [type(values[name]) for name in "ifvb"] == [int, float, tuple, bool]
    assert type(config.body.trim) is float


# --- Any right config survives being written and read again.

finite = st.floats(-1e6, 1e6).map(lambda x: x + 0.0)
positive = st.floats(1e-3, 1e3)
names = st.from_regex(r"[a-z][a-z0-9_-]{0,15}", fullmatch=True)
texts = st.text(st.characters(exclude_categories=["Cs"]), max_size=20)
values = st.one_of(
    finite, st.integers(-(2**63), 2**63 - 1), st.booleans(), texts, st.lists(finite, max_size=4).map(tuple)
)
parameter_names = st.from_regex(r"[a-z][A-Za-z0-9_]{0,10}", fullmatch=True).filter(lambda name: name != "robots")
parameters = st.dictionaries(parameter_names, values, max_size=4)


def bodies(payload: float | None = None):
    """`payload` of the common body: a robot can have another one, but cannot do without."""
    payloads = st.floats(0.01, 1) if payload is not None else st.none() | st.floats(0.01, 1)
    return st.builds(Body, positive, positive, positive, st.floats(-0.5, 0.5), payloads, positive)


balancings = st.builds(
    Balancing,
    st.sampled_from(["lqr", "pololu", "thesis"]),
    st.floats(0.01, 0.6),
    st.floats(0.1, 6),
    st.floats(0.1, 1),
    st.floats(0.1, 20),
    st.floats(6.6, 20),
    st.floats(0.1, 6.5),
)


@st.composite
def swarms(draw):
    robot_names = draw(st.lists(names, min_size=1, max_size=8, unique=True))
    robots = []
    for i, name in enumerate(robot_names):
        kind = draw(st.sampled_from(["rfcomm", "tcp", "sim", "both"]))
        robots.append(
            RobotConfig(
                name,
                board=draw(st.sampled_from(["zero2w", "pi4"])),
                bluetooth=f"B8:27:EB:00:00:{i:02X}" if kind in ("rfcomm", "both") else None,
                link={
                    "tcp": f"tcp:[::1]:{7000 + i}",
                    "sim": f"sim:/run/ü {i}/mesh.sock",
                    "both": f"tcp:host-{i}:1",
                }.get(kind),
            )
        )
    shape = draw(st.sampled_from(["line", "loop", "full"]) | st.integers(0, 999).map("random:{}".format))
    heartbeat, suspect, dead, patience = sorted(draw(st.lists(positive, min_size=4, max_size=4, unique=True)))
    relay = []
    for keys in draw(
        st.sets(
            st.sampled_from(["swarm/{self}/**", "swarm/{self}/dwm/*", "swarm/{self}/app/{peer}/x", "swarm/{self}/a/b"])
        )
    ):
        queue = draw(st.sampled_from(["latest", "all"]))
        relay.append(
            RelayRule(
                keys,
                priority=draw(st.sampled_from(["control", "sync", "bulk"])),
                queue=queue,
                max_rate=draw(st.none() | positive) if queue == "latest" else None,
            )
        )
    addresses = draw(st.lists(st.from_regex(r"[0-9A-F]{4}", fullmatch=True), max_size=4, unique=True))
    of_robots = st.sampled_from(robot_names)
    pair = st.tuples(finite, finite)
    body = draw(bodies())
    security = draw(st.sampled_from([(True, None), (False, None), (False, "/some/key")]))
    return Config(
        path=FILE,
        network=draw(st.from_regex(r"[A-Za-z0-9._-]{1,32}", fullmatch=True)),
        robots=tuple(robots),
        edges=Graph.of_shape(shape, robot_names).edges,
        relay=DEFAULT_RELAY + tuple(relay),
        anchors=tuple(Anchor(address, draw(finite), draw(finite), draw(finite)) for address in addresses),
        mesh=MeshConfig(
            *security, draw(st.none() | st.just("0.0.0.0:7447")), heartbeat, suspect, dead, draw(positive), patience
        ),
        body=body,
        bodies=draw(st.dictionaries(of_robots, bodies(body.payload))),
        balancing=draw(balancings),
        balancings=draw(st.dictionaries(of_robots, balancings)),
        dwm=Dwm(
            source=draw(st.sampled_from(["serial:/dev/ttyS0", "replay:/tmp/a b/{robot}", 'replay:"\\'])),
            target=draw(st.none() | st.just("C933")),
            rate=draw(st.floats(0.1, 10)),
            filter=draw(st.sampled_from(FILTERS)),
            filters=draw(st.dictionaries(of_robots, st.sampled_from(FILTERS))),
            window=draw(st.integers(1, 100)),
            position_window=draw(st.none() | st.integers(1, 100)),
            latency=draw(st.floats(0, 0.4)),
            height=draw(finite),
            lever=draw(finite),
            calibration=draw(st.none() | st.just("of/{robot}.toml")),
            distance=Linear(draw(positive), draw(finite)),
            position=Affine((draw(pair), draw(pair)), draw(pair)),
        ),
        apps=draw(
            st.dictionaries(names, st.builds(AppConfig, parameters, st.dictionaries(of_robots, parameters)), max_size=3)
        ),
        simulation=SimulationConfig(
            draw(pair), draw(pair), draw(st.dictionaries(of_robots, st.tuples(finite, finite, finite)))
        ),
    )


@settings(max_examples=50, suppress_health_check=[HealthCheck.too_slow], deadline=None)
@given(swarms())
def test_written_and_read_again(config):
    assert parse(dump(config), config.path) == config


def test_relay_rules_that_cannot_be_written():
    config = dataclasses.replace(parse(THREE, FILE), relay=())
    with pytest.raises(LocalError, match="relay rules"):
        dump(config)


# --- Nothing but a ConfigError ever comes out.

ODD_VALUES = (
    "0", "-1", "1.5", "inf", "nan", "true", '""', '"\\u0000"', '"x"', "[]", "[[]]", "[[0]]", "{}", '{"" = 1}', "[{}]",
    "1979-05-27T07:32:00Z", "07:32:00", "99999999999999999999999", "1e308", "-0.0", "[1, [2, [3]]]", '["r0", "r1"]',
    '"swarm/{self}/{peer}/**"', '"random:18446744073709551615"', '"tcp:[::1]:1"', "[nan, nan, nan]", "9" * 5000,
)  # fmt: skip


@st.composite
def mutations(draw):
    """The example with some lines lost, doubled, moved, garbled or given another value."""
    lines = EXAMPLE.splitlines()
    for _ in range(draw(st.integers(1, 4))):
        i = draw(st.integers(0, len(lines) - 1))
        what = draw(
            st.sampled_from(
                ["drop", "double", "move", "value", "value", "value", "key", "garble", "table", "uncomment"]
            )
        )
        key, equals, _value = lines[i].partition(" = ")
        if what == "drop":
            del lines[i]
        elif what == "double":
            lines.insert(i, lines[i])
        elif what == "move":
            lines.insert(draw(st.integers(0, len(lines) - 1)), lines.pop(i))
        elif what == "value" and equals:
            lines[i] = f"{key} = {draw(st.sampled_from(ODD_VALUES))}"
        elif what == "key" and equals:
            lines[i] = f"{draw(st.sampled_from(['x', 'robots', 'name', key + 'x', chr(34) * 2]))} = {_value}"
        elif what == "garble":
            at = draw(st.integers(0, len(lines[i])))
            lines[i] = lines[i][:at] + draw(st.text(max_size=5)) + lines[i][at + draw(st.integers(0, 5)) :]
        elif what == "table":
            name = draw(
                st.sampled_from(["x", "apps", "apps.a.robots", "robots", "relay", "dwm.distance", "simulation.places"])
            )
            lines.insert(i, draw(st.sampled_from([f"[{name}]", f"[[{name}]]"])))
        elif what == "uncomment":
            lines[i] = lines[i].removeprefix("# ")
        if not lines:
            break
    return "\n".join(lines)


@settings(max_examples=400, suppress_health_check=[HealthCheck.too_slow], deadline=None)
@given(mutations())
def test_mutations_of_the_example_are_read_or_refused(text):
    try:
        config = parse(text, FILE)
    except ConfigError as error:
        message = str(error)
    else:
        assert parse(dump(config), FILE) == config
        return
    assert message.startswith("swarm.toml: ")
    assert message.isprintable()


@given(st.text(max_size=200))
def test_any_text_is_read_or_refused(text):
    with pytest.raises(ConfigError):
        parse(text, FILE)


# --- Where the file is, and which robot we are.


def test_packages_of_robots_are_read_written_and_refused_where_pip_would_take_them_for_options():
    text = THREE + '[robot]\npackages = ["numpy", "scipy==1.16.0", "numpy"]\n'
    config = parse(text, FILE)
    assert config.packages == ("numpy", "scipy==1.16.0")
    assert parse(dump(config), FILE) == config
    for wrong in ('["--index-url=http://x"]', '["a b"]', '["a @ http://x"]', '"numpy"', "[1]", '[""]'):
        with pytest.raises(ConfigError, match=r"\[robot\] packages.*like \[\"numpy\""):
            parse(THREE + f"[robot]\npackages = {wrong}\n", FILE)


def test_load_follows_the_environment(tmp_path, monkeypatch):
    path = tmp_path / "my.toml"
    path.write_text(THREE)
    monkeypatch.setenv("SWARM_CONFIG", str(path))
    assert load() == dataclasses.replace(parse(THREE, FILE), path=path)
    assert configuration.load(path).path == path


def test_load_says_where_it_looked_and_what_to_do_without_a_file(tmp_path, monkeypatch):
    monkeypatch.setenv("SWARM_CONFIG", str(tmp_path / "none.toml"))
    with pytest.raises(ConfigError, match=r"looked in /\S+/none\.toml; .* swarm config --example > swarm\.toml"):
        load()
    monkeypatch.delenv("SWARM_CONFIG")
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "own"))
    monkeypatch.chdir(tmp_path)
    looked = f"looked in {tmp_path}/swarm.toml, {tmp_path}/own/swarm/swarm.toml, /etc/swarm/swarm.toml"
    monkeypatch.setattr(find, "find", lambda: None)  # this machine may have one in /etc
    with pytest.raises(ConfigError, match=looked):
        load()


def test_a_file_in_the_working_directory_goes_before_the_users_own_before_the_systems(tmp_path, monkeypatch):
    monkeypatch.delenv("SWARM_CONFIG", raising=False)
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.setenv("XDG_CONFIG_HOME", "relative, so it does not count")
    monkeypatch.setattr(find, "SYSTEM", tmp_path / "etc")
    (tmp_path / "work").mkdir()
    monkeypatch.chdir(tmp_path / "work")
    assert find.find() is None
    for folder in ("etc", "home/.config/swarm", "work"):
        path = tmp_path / folder / "swarm.toml"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(THREE)
        assert find.find() == path
        assert load().path == path


def test_load_of_what_is_no_text(tmp_path):
    path = tmp_path / "swarm.toml"
    path.write_bytes(b'network = "\xff"')
    with pytest.raises(ConfigError, match="byte 11 is not UTF-8"):
        load(path)
    with pytest.raises(ConfigError, match="cannot be read: Is a directory"):
        load(tmp_path)
    with pytest.raises(ConfigError, match="cannot be read"):
        load(Path("a\0b"))


def test_who_am_i(monkeypatch):
    config = parse(THREE, FILE)
    monkeypatch.setenv("SWARM_ROBOT", "r1")
    assert who_am_i(config) == "r1"
    monkeypatch.setenv("SWARM_ROBOT", "r9")
    with pytest.raises(ConfigError, match=r"SWARM_ROBOT is 'r9', none of its robots \(r0, r1, r2\); set the variable"):
        who_am_i(config)
    monkeypatch.delenv("SWARM_ROBOT")
    monkeypatch.setattr(socket, "gethostname", lambda: "r2.local")
    assert who_am_i(config) == "r2"
    monkeypatch.setattr(socket, "gethostname", lambda: "laptop")
    with pytest.raises(ConfigError, match="the host name is 'laptop'"):
        who_am_i(config)


def test_places_are_in_radians():
    assert parse(EXAMPLE, FILE).simulation.places["r1"][2] == pytest.approx(math.pi / 2, abs=1e-3)


AUTO = 'network = "lab"\ntopology = "auto"\n[[robots]]\nname = "r0"\nlink = "tcp:h0:1"\n[[robots]]\nname = "r1"\n'


def test_an_automatic_topology():
    config = parse(AUTO + 'link = "tcp:h1:1"\n[mesh]\ninsecure = true', FILE)
    assert (config.auto, config.edges) == (True, ())
    assert parse(configuration.dump(config), FILE).auto
    assert not parse(EXAMPLE, FILE).auto


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        (AUTO, '[robots.1] bluetooth: with topology = "auto" each robot can be called by any other'),
        (AUTO.replace('"auto"', '"automatic"'), 'topology: expected "auto" or a table, written [topology], got'),
        (AUTO.replace('topology = "auto"\n', "") + '[topology]\nshape = "auto"', "expected line, loop"),
    ],
)
def test_what_is_no_automatic_topology(text, problem):
    with pytest.raises(ConfigError) as error:
        parse(text, FILE)
    assert problem in str(error.value)
