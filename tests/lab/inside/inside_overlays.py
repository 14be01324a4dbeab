"""Inside a machine: what apps get from the mesh over RFCOMM, each thing once: members, clock, floods, messages, large
payloads, relay rules, the stop key, another way around a robot that is not heard.

Over `sim:` the tests of tests/services/mesh ask more of each.
"""

import os
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TypeVar

import pytest
from conftest import Processes
from inside_swarm import NAMES, Swarm, come

from lab.radio.remote import Radio
from lab.waiting import PATIENCE_S, until
from swarm import clock
from swarm.app.mesh_clock import MeshClock
from swarm.app.overlays import Handle, Overlays
from swarm.messages import Flooded, Member, Sent, Stop, Stopped, read

A = TypeVar("A", Flooded, Sent)

FAR = "r3"
"""Of r0, three hops either way around the loop."""

CLOCK_S = 0.1
"""Within which mesh time must be right here, where all robots have the same clock; some ms on a machine with time."""


@pytest.fixture(scope="module")
def swarm(radio: Radio) -> Iterator[Swarm]:
    """Six robots in a loop; all tests of this file use it, and leave it whole."""
    with tempfile.TemporaryDirectory(prefix="sw", dir="/tmp") as folder:
        processes = Processes(Path(folder))
        made = Swarm(processes, "overlays")
        made.start_meshes()
        wait_here(made)
        yield made
        made.end()
        made.close()


@pytest.fixture
def overlays(swarm: Swarm, request: pytest.FixtureRequest) -> dict[str, Overlays]:
    """Of an app named like the test, one a robot, each of which keeps what comes."""
    app = request.node.name.removeprefix("test_").replace("_", "")[:16]
    found = {name: Overlays(swarm.buses[name], name, app) for name in NAMES}
    for each in found.values():
        each.collect()
    time.sleep(0.5)  # until the routers know of it
    return found


def answer(what: str, handle: Handle[A]) -> A:
    """Wait for what the mesh says a message or flood came to."""
    return until(f"the mesh answers: {what}", lambda: handle.answer, state=lambda: f"{handle.moved} bytes moved")


def members(swarm: Swarm, name: str) -> dict[str, Member]:
    return {each.robot: each for each in swarm.ask(name, "members").members}


def wait_here(swarm: Swarm) -> None:
    """All see all, and by the shortest way."""
    swarm.wait(
        "each robot sees each by the shortest way",
        lambda: all(whole(swarm, name) for name in NAMES),
        lambda: {
            name: {each.robot: (each.state, each.hops) for each in members(swarm, name).values()} for name in NAMES
        },
    )


def whole(swarm: Swarm, name: str) -> bool:
    me = NAMES.index(name)
    return all(
        each.state == "here" and each.hops == min((me - i) % 6, (i - me) % 6)
        for i, each in ((NAMES.index(robot), member) for robot, member in members(swarm, name).items())
        if i != me
    )


def test_a_flood_reaches_everybody_once(overlays: dict[str, Overlays]) -> None:
    reached = answer("the flood", overlays["r0"].flood(b"hello", announce=True))
    assert reached.complete
    assert reached.robots == tuple(NAMES[1:])
    for name, each in overlays.items():
        assert come(each, name != "r0") == ([] if name == "r0" else [("r0", b"hello", True)])


def test_each_robot_has_a_message_for_each(overlays: dict[str, Overlays]) -> None:
    pairs = [(one, other) for one in NAMES for other in NAMES if one != other]
    handles = {f"{one}>{other}": overlays[one].send(other, f"{one}>{other}".encode()) for one, other in pairs}
    assert all(answer(pair, handle).delivered for pair, handle in handles.items())
    for name, each in overlays.items():
        wanted = sorted((one, f"{one}>{other}".encode(), False) for one, other in pairs if other == name)
        assert sorted(come(each, len(wanted))) == wanted
    assert answer("r0>r9", overlays["r0"].send("r9", b"x")).problem == "there is no robot r9"


def test_a_large_payload_arrives_whole(overlays: dict[str, Overlays]) -> None:
    payload = os.urandom(100_000)
    assert answer("100 kB by unicast", overlays["r0"].send(FAR, payload, timeout=PATIENCE_S)).delivered
    assert come(overlays[FAR], 1) == [("r0", payload, False)]
    assert answer("100 kB by flood", overlays[FAR].flood(payload)).complete
    assert come(overlays["r0"], 1) == [(FAR, payload, True)]


def test_mesh_time_is_the_same_everywhere(swarm: Swarm) -> None:
    clocks = {name: MeshClock(swarm.buses[name], name) for name in NAMES}
    swarm.wait(
        "the root of all clocks is r0",
        lambda: all(each.root == "r0" for each in clocks.values()),
        lambda: {name: each.root for name, each in clocks.items()},
    )
    # One machine, one monotonic clock: mesh time is that of r0, which is everybody's.
    off: dict[str, float] = {}

    def right() -> bool:
        off.update({name: (each.now() or 0.0) - clock.now() for name, each in clocks.items()})
        return max(map(abs, off.values())) < CLOCK_S

    swarm.wait("mesh time is right everywhere", right, lambda: off)


def test_keys_travel_as_far_as_their_rules_say(swarm: Swarm) -> None:
    """By flood, by unicast, and to neighbours alone, as the config says; what no rule names stays at home."""
    seen: dict[str, Counter[str]] = {name: Counter() for name in NAMES}

    def note(name: str) -> Callable[[str, bytes], None]:
        return lambda key, payload: seen[name].update([key])

    for name in NAMES:
        keys = ("swarm/r0/dwm/pose", "swarm/*/balancer/set/*", "swarm/r0/app/x/sync/**")
        swarm.buses[name].subscribe(keys, note(name))
    time.sleep(1.0)  # until the routers know of it
    pose, leds, sync = "swarm/r0/dwm/pose", f"swarm/{FAR}/balancer/set/leds", "swarm/r0/app/x/sync/1-0-0-1"
    for key in (pose, leds, f"swarm/{FAR}/balancer/set/mode", sync):
        swarm.buses["r0"].publish(key, b"x")
    wanted = {name: Counter([pose]) for name in NAMES}
    wanted["r0"].clear()  # a bus does not hear itself
    wanted[FAR].update([leds])
    for name in ("r1", "r5"):
        wanted[name].update([sync])
    swarm.wait("the rules have carried the keys", lambda: seen == wanted, lambda: seen)


def test_a_stop_reaches_all_and_is_taken_back(swarm: Swarm, overlays: dict[str, Overlays]) -> None:
    states: dict[str, Stopped] = {}
    for name in NAMES:
        swarm.buses[name].subscribe(
            f"swarm/{name}/mesh/stopped", lambda key, data: states.update({key.split("/")[1]: read(key, data)})
        )
    swarm.buses["r0"].publish("swarm/stop", Stop(0.0, "somebody", "smoke"), urgent=True)
    swarm.wait(
        "all six are stopped by r0",
        lambda: len(states) == 6 and all(each.by == {"r0": "smoke"} for each in states.values()),
        lambda: states,
    )
    overlays["r2"].arm()
    swarm.wait("none is stopped", lambda: not any(each.stopped for each in states.values()), lambda: states)


def test_messages_take_another_way(swarm: Swarm, overlays: dict[str, Overlays], radio: Radio) -> None:
    radio.order("silence", address=radio.addresses[1])
    assert answer("r0>r2 around r1", overlays["r0"].send("r2", b"around", timeout=PATIENCE_S)).delivered
    assert come(overlays["r2"], 1) == [("r0", b"around", False)]
    swarm.wait(
        "r0 reaches r2 by four hops, the other way around",
        lambda: members(swarm, "r0")["r2"].hops == 4,
        lambda: members(swarm, "r0"),
    )
    swarm.wait("r0 takes r1 for gone", lambda: members(swarm, "r0")["r1"].state == "gone", lambda: members(swarm, "r0"))
    radio.order("unsilence", address=radio.addresses[1])
    wait_here(swarm)
