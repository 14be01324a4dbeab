"""swarm.toml: any right configuration survives being written and read again."""

import dataclasses

import pytest
from config_texts import FILE, THREE
from conftest import examples
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

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
    parse,
)
from swarm.config.sections import FILTERS
from swarm.core.graph import Graph
from swarm.errors import LocalError

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
        kind = draw(st.sampled_from(["rfcomm", "tcp", "sim", "slots", "both"]))
        robots.append(
            RobotConfig(
                name,
                board=draw(st.sampled_from(["zero2w", "pi4"])),
                bluetooth=f"B8:27:EB:00:00:{i:02X}" if kind in ("rfcomm", "both") else None,
                link={
                    "tcp": f"tcp:[::1]:{7000 + i}",
                    "sim": f"sim:/run/ü {i}/mesh.sock",
                    "slots": f"slots:/run/ü {i}/mesh.sock",
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


@settings(max_examples=examples(50), suppress_health_check=[HealthCheck.too_slow], deadline=None)
@given(swarms())
def test_a_configuration_is_read_as_it_was_written(config):
    assert parse(dump(config), config.path) == config


def test_relay_rules_that_cannot_be_written():
    config = dataclasses.replace(parse(THREE, FILE), relay=())
    with pytest.raises(LocalError, match="relay rules"):
        dump(config)
