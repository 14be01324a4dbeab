"""swarm.toml: what every wrong file is told, and that nothing but a `ConfigError` ever comes out."""

import pytest
from config_texts import FILE, ONE, THREE, radio, swap
from conftest import examples
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from swarm.config import (
    dump,
    parse,
)
from swarm.config.example import EXAMPLE
from swarm.errors import ConfigError


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
        (
            swap('"r1"', '"r1"\nhost = "me@10.0.0.9"').replace('"r0"', '"r0"\nhost = "10.0.0.9"', 1),
            "[robots.1] host: '10.0.0.9' is already that of robot r0",
        ),
        (swap('"r0"', '"r0"\nhost = "pi@R1"'), "[robots.1] host: 'r1' is already that of robot r0"),
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
            radio(9, 'shape = "full"').replace("[mesh]\n", '[mesh]\nlinks = "graph"\n'),
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
def test_a_wrong_entry_is_named_with_the_mend(text, message):
    with pytest.raises(ConfigError) as caught:
        parse(text, FILE)
    assert str(caught.value).startswith(f"swarm.toml: {message}")
    assert len(str(caught.value)) < 300
    assert "\n" not in str(caught.value)


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


@settings(max_examples=examples(400), suppress_health_check=[HealthCheck.too_slow], deadline=None)
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
