"""Overlays between real mesh processes with real buses: what apps, rules and the stop key get."""

import os

import pytest
from conftest import ask, stop, wait_until
from mesh_rig import Build, Swarm, build

from swarm.app.overlays import Overlays
from swarm.messages import Member, Stop, Stopped, read

__all__ = ["build"]

LINE = (("r0", "r1"), ("r1", "r2"), ("r2", "r3"))
LOOP = (*LINE, ("r3", "r0"))
RULES = (
    '[[relay]]\nkeys = "swarm/{self}/dwm/pose"\noverlay = "flood"\n'
    '[[relay]]\nkeys = "swarm/{peer}/balancer/set/leds"\noverlay = "unicast"\npriority = "sync"\n'
)


def members(swarm: Swarm, name: str) -> dict[str, Member]:
    """As a robot sees them."""
    key = f"swarm/{name}/mesh/members"
    return {each.robot: each for each in read(key, ask(swarm[name].bus, key)).members}


def wait_here(swarm: Swarm) -> None:
    def here() -> bool:
        return all(each.state == "here" for name in swarm.robots for each in members(swarm, name).values())

    wait_until(here, what="all see all")


def test_apps_flood_and_send_and_learn_what_became_of_it(build: Build) -> None:
    swarm = build(edges=LINE, model="latency=0.005")
    swarm.start()
    wait_here(swarm)
    got: list[tuple[str, str, bytes]] = []
    completed: list[tuple[str, str]] = []
    overlays = {name: Overlays(robot.bus, name, "test") for name, robot in swarm.robots.items()}
    for name, each in overlays.items():
        each.on_flood(lambda origin, payload, name=name: got.append((name, origin, payload)))  # type: ignore[misc]
        each.on_message(lambda sender, payload, name=name: got.append((name, sender, payload)))  # type: ignore[misc]
        each.on_complete(lambda origin, answer, name=name: completed.append((name, origin)))  # type: ignore[misc]
    reached = overlays["r0"].flood(b"hello", announce=True).result(60.0)
    assert reached.complete
    assert reached.robots == ("r1", "r2", "r3")
    wait_until(lambda: len(got) == 3 and len(completed) == 3)
    assert sorted(got) == [(name, "r0", b"hello") for name in ("r1", "r2", "r3")]
    got.clear()
    handles = [overlays[name].send(to, f"{name}>{to}".encode()) for name in overlays for to in overlays if to != name]
    assert all(handle.result(60.0).delivered for handle in handles)
    wait_until(lambda: len(got) == 12)
    assert sorted(got) == sorted(
        (to, name, f"{name}>{to}".encode()) for name in overlays for to in overlays if to != name
    )
    answers: list[str] = []
    overlays["r0"].send("r9", b"x").on_done(lambda sent: answers.append(sent.problem))
    wait_until(lambda: answers == ["there is no robot r9"])


@pytest.mark.slow
def test_large_payloads_of_apps_cross_the_swarm(build: Build) -> None:
    swarm = build(edges=LINE, model="latency=0.005,bandwidth=400000")
    swarm.start()
    wait_here(swarm)
    overlays = {name: Overlays(robot.bus, name, "test") for name, robot in swarm.robots.items()}
    came: list[tuple[str, bytes]] = []
    for name in ("r1", "r2", "r3"):
        overlays[name].on_flood(lambda origin, payload, name=name: came.append((name, payload)))  # type: ignore[misc]
    overlays["r3"].on_message(lambda sender, payload: came.append((sender, payload)))
    payload = os.urandom(950_000)
    handle = overlays["r0"].send("r3", payload, timeout=120.0)
    wait_until(lambda: handle.answer is None and 0 < handle.moved < len(payload), what="it is under way")
    assert handle.result(120.0).delivered
    wait_until(lambda: came == [("r0", payload)])
    flooded = overlays["r0"].flood(payload).result(120.0)
    assert flooded.complete
    assert flooded.robots == ("r1", "r2", "r3")
    wait_until(lambda: sorted(came[1:]) == [(name, payload) for name in ("r1", "r2", "r3")])


def test_rules_flood_and_command_across_the_swarm(build: Build) -> None:
    swarm = build(edges=LINE, extra=RULES)
    seen: dict[str, list[tuple[str, bytes]]] = {name: [] for name in swarm.robots}
    for name, robot in swarm.robots.items():
        keys = ("swarm/*/dwm/pose", "swarm/*/balancer/set/*")
        robot.bus.subscribe(keys, lambda key, payload, name=name: seen[name].append((key, payload)))  # type: ignore[misc]
    swarm.start()
    wait_here(swarm)
    bus = swarm["r0"].bus
    for key in ("swarm/r0/dwm/pose", "swarm/r3/balancer/set/leds", "swarm/r3/balancer/set/mode", "swarm/r1/dwm/pose"):
        bus.publish(key, b"x")
    wait_until(lambda: [len(seen[name]) for name in ("r1", "r2", "r3")] == [1, 1, 2])
    assert sorted(seen["r3"]) == [("swarm/r0/dwm/pose", b"x"), ("swarm/r3/balancer/set/leds", b"x")]
    assert seen["r1"] == seen["r2"] == [("swarm/r0/dwm/pose", b"x")]
    # Who comes later gets the latest value.
    robot = swarm["r3"]
    assert robot.mesh is not None
    assert stop(robot.mesh) == 0
    wait_until(lambda: members(swarm, "r0")["r3"].state == "left", what="r3 has left")
    bus.publish("swarm/r0/dwm/pose", b"newer")
    seen["r3"].clear()
    robot.start()
    wait_until(lambda: ("swarm/r0/dwm/pose", b"newer") in seen["r3"])


def test_a_stop_holds_on_every_robot_until_it_is_taken_back(build: Build) -> None:
    swarm = build(edges=LINE)
    stops: dict[str, list[Stop]] = {name: [] for name in swarm.robots}
    states: dict[str, Stopped] = {}

    def note(name: str, key: str, payload: bytes) -> None:
        message = read(key, payload)
        if isinstance(message, Stop):
            stops[name].append(message)
        else:
            states[name] = message

    for name, robot in swarm.robots.items():
        robot.bus.subscribe(
            ("swarm/stop", f"swarm/{name}/mesh/stopped"), lambda key, data, name=name: note(name, key, data)
        )  # type: ignore[misc]
    swarm.start()
    wait_here(swarm)
    swarm["r0"].bus.publish("swarm/stop", Stop(0.0, "somebody", "smoke"), urgent=True)
    wait_until(lambda: len(states) == 4 and all(state.by == {"r0": "smoke"} for state in states.values()))
    wait_until(lambda: len(stops["r3"]) >= 2, what="it is repeated")
    assert stops["r3"][0].origin == "r0"
    # A mesh that is started anew is stopped, too.
    robot = swarm["r3"]
    assert robot.mesh is not None
    robot.mesh.kill()
    robot.mesh.wait()
    states.clear()
    robot.start()
    wait_until(lambda: "r3" in states and states["r3"].stopped)
    Overlays(swarm["r2"].bus, "r2", "test").arm()
    wait_until(lambda: len(states) == 4 and not any(state.stopped for state in states.values()))


def test_messages_go_another_way_when_a_robot_dies(build: Build) -> None:
    swarm = build(edges=LOOP, model="latency=0.005")
    swarm.start()
    wait_here(swarm)
    wait_until(lambda: members(swarm, "r0")["r2"].via == "r1", what="the map is whole")
    overlays = Overlays(swarm["r0"].bus, "r0", "test")
    robot = swarm["r1"]
    assert robot.mesh is not None
    robot.mesh.kill()
    assert overlays.send("r2", b"x").result(60.0).delivered
    wait_until(lambda: members(swarm, "r0")["r1"].state == "gone")
    member = members(swarm, "r0")["r2"]
    assert (member.state, member.via, member.hops) == ("here", "r3", 2)
    robot.start()
    wait_here(swarm)
