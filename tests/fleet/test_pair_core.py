"""Pairing's decisions, and the bytes of D-Bus that it speaks."""

import contextlib
import tomllib
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from laptop.fleet.core.pairing import Bond, Schedule, check, edges, ordered, plan, with_addresses
from swarm.config import parse
from swarm.onboard.bootstrap import dbus_wire as wire
from swarm.onboard.bootstrap.dbus_wire import DbusMessage, WireError

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
    schedule, running, done = Schedule(list(wanted)), [], []
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


def test_who_is_who() -> None:
    config = parse(CONFIG, Path("swarm.toml"), addressed=False)
    assert edges(config, config.names) == [("r0", "r1"), ("r1", "r2")]
    assert edges(config, ["r1", "r2"]) == [("r1", "r2")]
    assert ordered([("r0", "r1")], {"r0": "B", "r1": "A"}) == [("r1", "r0")]
    assert check(config, {"r0": "B8:27:EB:00:00:10", "r2": "B8:27:EB:00:00:12"}) == {}
    assert "is that of r2" in check(config, {"r0": "B8:27:EB:00:00:12"})["r0"]
    assert "swarm.toml says B8:27:EB:00:00:12" in check(config, {"r2": "B8:27:EB:00:00:13"})["r2"]
    assert set(check(config, {"r0": "A", "r1": "A"})) == {"r0", "r1"}


# -- D-Bus ---------------------------------------------------------------------------------------------------------

simple = {
    "y": st.integers(0, 255), "b": st.booleans(), "n": st.integers(-(2**15), 2**15 - 1), "q": st.integers(0, 2**16 - 1),
    "i": st.integers(-(2**31), 2**31 - 1), "u": st.integers(0, 2**32 - 1), "x": st.integers(-(2**63), 2**63 - 1),
    "t": st.integers(0, 2**64 - 1), "d": st.floats(allow_nan=False), "s": st.text(max_size=9), "o": st.just("/a/b"),
    "g": st.just("a{sv}"),
}  # fmt: skip
kinds = st.recursive(
    st.sampled_from([*simple, "v"]),
    lambda inner: (
        inner.map(lambda kind: "a" + kind)
        | st.lists(inner, min_size=1, max_size=3).map(lambda members: f"({''.join(members)})")
        | st.tuples(st.sampled_from("yusx"), inner).map(lambda pair: f"a{{{pair[0]}{pair[1]}}}")
    ),
    max_leaves=4,
)


def values(kind: str) -> st.SearchStrategy[Any]:
    """Values of a complete type."""
    if kind in simple:
        return simple[kind]
    if kind == "v":
        return st.sampled_from(["s", "u", "as", "(ib)"]).flatmap(lambda inner: st.tuples(st.just(inner), values(inner)))
    if kind.startswith("a{"):
        return st.dictionaries(values(kind[2]), values(kind[3:-1]), max_size=3)
    if kind.startswith("a"):
        return st.lists(values(kind[1:]), max_size=3)
    return st.tuples(*(values(inner) for inner in wire.split(kind[1:-1])))


@given(st.lists(kinds, max_size=3).flatmap(lambda types: st.tuples(st.just(types), st.tuples(*map(values, types)))))
def test_what_is_written_is_read(case: tuple[list[str], tuple[Any, ...]]) -> None:
    types, body = case
    signature = "".join(types)
    assert wire.split(signature) == types
    assert wire.unmarshal(signature, bytes(wire.marshal(signature, list(body)))) == list(body)
    fields = {"path": "/", "member": "M"} | ({"signature": signature} if signature else {})
    data = wire.encode(DbusMessage(wire.CALL, 7, fields, list(body)))
    assert wire.size(data) == len(data)
    assert wire.decode(data) == DbusMessage(wire.CALL, 7, fields, list(body))


def test_a_call_is_these_bytes() -> None:
    """Hello, as libdbus writes it but for the flag and the order of the header's fields (any order is allowed)."""
    name = "org.freedesktop.DBus"
    fields = {"path": "/org/freedesktop/DBus", "destination": name, "interface": name, "member": "Hello"}
    assert wire.encode(DbusMessage(wire.CALL, 1, fields)).hex(" ", 8) == (
        "6c01020100000000 010000006e000000 01016f0015000000 2f6f72672f667265 656465736b746f70 2f44427573000000"
        " 0601730014000000 6f72672e66726565 6465736b746f702e 4442757300000000 0201730014000000 6f72672e66726565"
        " 6465736b746f702e 4442757300000000 0301730005000000 48656c6c6f000000"
    )


@given(st.binary(max_size=80), st.sampled_from(["a{sv}", "a(yv)", "s", "v", "aas", "(su)", "ab"]), st.booleans())
def test_any_bytes_are_read_or_refused(data: bytes, signature: str, little: bool) -> None:
    with contextlib.suppress(WireError):
        wire.unmarshal(signature, data, little=little)


@given(st.binary(max_size=40), st.integers(0, 60))
def test_any_message_is_read_or_refused(data: bytes, at: int) -> None:
    good = wire.encode(DbusMessage(wire.CALL, 1, {"path": "/", "member": "M", "signature": "s"}, ["x"]))
    for bad in (data, good[:at] + data + good[at:], good[:at] + data):
        try:
            wire.size(bad)
            wire.decode(bad)
        except WireError:
            continue


@pytest.mark.parametrize("signature", ["(", "a", "()", "{sv", "a{s}", "a{sss}", "z", ")", "(" * 70 + "y" + ")" * 70])
def test_signatures_that_are_none(signature: str) -> None:
    with pytest.raises(WireError):
        wire.split(signature)


@pytest.mark.parametrize(
    ("signature", "value"), [("u", -1), ("s", 3), ("y", 300), ("as", 5), ("v", ("ss", "x")), ("(su)", ("x",))]
)
def test_values_that_do_not_fit(signature: str, value: object) -> None:
    with pytest.raises(WireError):
        wire.marshal(signature, [value])
