"""swarm.toml: what a right file means, where it is looked for, and which robot this is."""

import dataclasses
import math
import re
import socket
from pathlib import Path

import pytest
from config_texts import FILE, ONE, THREE, radio, swap

from swarm import config as configuration
from swarm.config import (
    DEFAULT_RELAY,
    Affine,
    AppConfig,
    Balancing,
    Body,
    Config,
    Dwm,
    Linear,
    MeshConfig,
    RelayRule,
    RobotConfig,
    dump,
    find,
    load,
    parse,
    types,
    who_am_i,
)
from swarm.config.example import EXAMPLE
from swarm.core.graph import Graph
from swarm.errors import ConfigError


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


def test_seven_radio_links_are_the_limit_only_where_radio_is_used():
    assert len(parse(radio(8, 'shape = "full"'), FILE).edges) == 28
    for links in ("auto", "tree"):
        carried = radio(9, 'shape = "full"').replace("[mesh]\n", f'[mesh]\nlinks = "{links}"\n')
        assert len(parse(carried, FILE).edges) == 36, "hubs carry it"
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


def test_a_matrix_of_an_app_is_read_row_by_row():
    values = parse(ONE + "[apps.a]\nP = [[1, 2], [3, 4]]\nT = [[[1], [2]], [[3], [4]]]", FILE).app("a").of("r0")
    assert values == {"P": (1.0, 2.0, 3.0, 4.0), "T": (1.0, 2.0, 3.0, 4.0)}
    for wrong in ("[[1, 2], [3]]", "[[1], 2]", "[['a']]"):
        with pytest.raises(ConfigError, match=r"\[apps.a\] P: expected a finite number"):
            parse(ONE + f"[apps.a]\nP = {wrong}", FILE)


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
    with pytest.raises(ConfigError, match=r"none\.toml: there is no such file, which the variable SWARM_CONFIG names;"):
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


def test_a_working_directory_that_was_deleted_keeps_no_file_from_being_found(monkeypatch, tmp_path):
    (tmp_path / "etc").mkdir()
    (tmp_path / "etc/swarm.toml").write_text("")
    (tmp_path / "gone").mkdir()
    monkeypatch.chdir(tmp_path / "gone")
    (tmp_path / "gone").rmdir()
    monkeypatch.delenv("SWARM_CONFIG", raising=False)
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    monkeypatch.setattr(find, "SYSTEM", tmp_path / "etc")
    assert find.find() == tmp_path / "etc/swarm.toml"


def test_a_robot_finds_its_own_name(monkeypatch):
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


def test_an_automatic_topology_has_no_edges_and_survives_a_dump():
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
