"""Decisions of `swarm pair`: which robots, in what order, and what is written into swarm.toml."""

import tomllib
from pathlib import Path
from typing import Any

from hypothesis import given
from hypothesis import strategies as st

from laptop.fleet.core.pairing import Bond, PairingSchedule, bluetooth_links, check, ordered, plan, with_addresses
from swarm.config import parse

bonds = st.none() | st.builds(Bond, st.booleans(), st.booleans())


@given(bonds, bonds)
def test_a_plan_leads_to_what_needs_none(a: Bond | None, b: Bond | None) -> None:
    ends: dict[str, Bond | None] = {"a": a, "b": b}
    for step in plan(a, b):
        do, _, end = step.partition("-")
        if do == "forget":
            ends[end] = None
        elif do == "trust":
            assert ends[end] == Bond(True, False)
            ends[end] = Bond(True, True)
        else:
            assert ends == {"a": None, "b": None}  # bluetoothd knows an old key otherwise
            ends = {"a": Bond(True, True), "b": Bond(True, True)}
    assert plan(ends["a"], ends["b"]) == []


@given(st.sets(st.tuples(st.integers(0, 5), st.integers(0, 5)).filter(lambda e: e[0] < e[1])), st.randoms())
def test_all_links_have_their_turn_and_no_robot_two_at_once(pairs: set[tuple[int, int]], random: Any) -> None:
    wanted = [(f"r{a}", f"r{b}") for a, b in sorted(pairs)]
    schedule, running, done = PairingSchedule(list(wanted)), [], []
    while schedule.waiting or running:
        running += schedule.start()
        robots = [name for edge in running for name in edge]
        assert len(set(robots)) == len(robots)
        assert running
        edge = running.pop(random.randrange(len(running)))
        schedule.done(edge)
        done.append(edge)
    assert sorted(done) == wanted


CONFIG = """network = "x"
[topology]
edges = [["r0", "r1"], ["r1", "r2"]]
[[ robots ]]
name = "r0" # name = "r1"
[[robots]]
name = 'r1'
board = "pi4"
[[robots]]
name = "r2"
bluetooth = "B8:27:EB:00:00:12"
[mesh]
insecure = true
[apps.name]
name = "r0"
"""


def test_addresses_are_written_below_names_and_nowhere_else() -> None:
    text = with_addresses(CONFIG, {"r0": "B8:27:EB:00:00:10", "r1": "B8:27:EB:00:00:11"})
    assert [line for line in text.splitlines() if line not in CONFIG.splitlines()] == [
        'bluetooth = "B8:27:EB:00:00:10"',
        'bluetooth = "B8:27:EB:00:00:11"',
    ]
    robots = tomllib.loads(text)["robots"]
    assert [robot["bluetooth"][-2:] for robot in robots] == ["10", "11", "12"]
    assert with_addresses(CONFIG, {}) == CONFIG


def test_addresses_of_robots_are_compared_with_swarm_toml() -> None:
    config = parse(CONFIG, Path("swarm.toml"), addressed=False)
    assert bluetooth_links(config, config.names) == [("r0", "r1"), ("r1", "r2")]
    assert bluetooth_links(config, ["r1", "r2"]) == [("r1", "r2")]
    assert ordered([("r0", "r1")], {"r0": "B", "r1": "A"}) == [("r1", "r0")]
    assert check(config, {"r0": "B8:27:EB:00:00:10", "r2": "B8:27:EB:00:00:12"}) == {}
    assert "is that of r2" in check(config, {"r0": "B8:27:EB:00:00:12"})["r0"]
    assert "swarm.toml says B8:27:EB:00:00:12" in check(config, {"r2": "B8:27:EB:00:00:13"})["r2"]
    assert set(check(config, {"r0": "A", "r1": "A"})) == {"r0", "r1"}


def test_any_two_robots_are_paired_where_hubs_with_successors_carry_the_topology() -> None:
    robots = "".join(f'[[robots]]\nname = "r{i}"\nbluetooth = "B8:27:EB:00:00:1{i}"\n' for i in range(4))
    line = [("r0", "r1"), ("r1", "r2"), ("r2", "r3")]
    for links, wanted in (("graph", 3), ("star", 6), ("tree", 6), ("auto", 6)):
        text = f'network = "x"\n{robots}[topology]\nshape = "line"\n[mesh]\ninsecure = true\nlinks = "{links}"\n'
        config = parse(text, Path("swarm.toml"))
        found = bluetooth_links(config, config.names)
        assert len(found) == wanted
        assert set(line) <= set(found)
