"""What robots tell to whoever watches the swarm through one of them: how much, for how long, and to whom."""

from dataclasses import replace

import pytest
from conftest import wait_until
from hypothesis import given
from hypothesis import strategies as st
from mesh_rig import SHORT, Build, build, log_of
from overlay_world import World

from services.mesh.core.overlays.viewing import (
    BUDGET,
    FULL_EVERY,
    KEYS,
    LARGEST,
    LONGEST_S,
    MAX_APP_BYTES,
    MAX_APP_KEYS,
    MAX_SERVICES,
    REPEAT_S,
    TYPICAL,
    Viewing,
)
from services.mesh.core.wire.frames import BULK
from swarm import clock
from swarm.messages import (
    AppProgress,
    AppState,
    BalancerFault,
    BalancerState,
    Leds,
    Links,
    LinkState,
    Pose,
    Status,
    View,
    Watch,
)
from swarm.messages.codec import MAX_PAYLOAD, decode, encode, unpack

__all__ = ["build"]

WATCH = Watch(1.0, 15.0)
LINKS = tuple(LinkState(f"r{n}", "up", 1, 0.0612, 12345, 12345, "", 0.06, 0.061, 0.07, 1466.0, 1500.0) for n in (0, 2))
TYPICAL_SAMPLES = {
    "dwm/pose": Pose(1.0, 7, 1.234, 2.345, 0.5, 80, "ekf", 0.05, 0.06, 0.1, 0.02),
    "balancer/state": BalancerState(
        1.0, "balancing", 0.01, 0.0, 0.0, 0.1, 0.1, 7.4, 100, 1e-4, 2e-4, "", battery_level="ok", battery_left=3000.0
    ),
    "balancer/leds": Leds(1.0, red=True, yellow=False, green=True),
    "balancer/fault": BalancerFault(1.0, "", "", ""),
    "mesh/links": Links(1.0, LINKS),
    "app/localization/state": AppState(1.0, 120, {"x": 1.0, "y": 2.0}, {"x": 1.0, "y": 2.0, "sigma": 0.1}),
    "app/localization/progress": AppProgress(1.0, "running", 120, (), ""),
}
SERVICES = ("mesh", "balancer", "dwm", "app/localization")


def full(robot: str = "r1", robots: int = 6) -> Viewing:
    viewing = Viewing(robot, robots)
    viewing.asked(WATCH, "r0", 0.0)
    for topic, message in TYPICAL_SAMPLES.items():
        viewing.take(f"swarm/{robot}/{topic}", encode(message))
    for service in SERVICES:
        viewing.alive(f"swarm/{robot}/{service}/alive", True)
        viewing.take(f"swarm/{robot}/{service}/status", encode(Status(1.0, service, "ready", "", 1, 0.0, {})))
    return viewing


def view(viewing: Viewing, now: float) -> View:
    due = viewing.due(now)
    assert due is not None
    return decode(View, due[1], "swarm/r1/mesh/view")


def test_nothing_is_told_that_nobody_asks_for() -> None:
    viewing = Viewing("r1", 6)
    assert not viewing.active(0.0)
    assert viewing.due(0.0) is None


def test_viewing_ends_by_itself_and_forgets_what_it_heard() -> None:
    viewing = full()
    assert viewing.due(14.9) is not None
    assert not viewing.active(15.0)
    assert viewing.due(15.0) is None
    viewing.asked(WATCH, "r0", 20.0)
    assert view(viewing, 20.0) == View(20.0, {}, {})
    viewing.asked(Watch(1.0, 1e9), "r0", 20.0)
    assert not viewing.active(20.0 + LONGEST_S)


def test_each_watched_robot_gets_it_and_asking_again_prolongs_it() -> None:
    viewing = full()
    viewing.asked(WATCH, "r5", 5.0)
    due = viewing.due(5.0)
    assert due is not None
    assert due[0] == ("r0", "r5")
    due = viewing.due(16.0)
    assert due is not None
    assert due[0] == ("r5",)


def test_two_viewers_of_one_robot_make_one_request() -> None:
    viewing = Viewing("r1", 6)
    assert [viewing.ask(now) for now in (0.0, 0.1, REPEAT_S - 0.1, REPEAT_S)] == [True, False, False, True]


def test_what_a_person_looks_at_is_in_it_and_it_is_small() -> None:
    told = view(viewing := full(), 0.0)
    assert told.services == dict.fromkeys(sorted(SERVICES), "ready")
    assert set(told.values) == set(TYPICAL_SAMPLES)
    pose, links = unpack(told.values["dwm/pose"]), unpack(told.values["mesh/links"])
    assert (round(pose["x"], 6), pose["quality"], "raw_x" in pose) == (1.234, 80, False)
    assert links["links"][1]["peer"] == "r2"
    # Then what changes.
    sizes = [len(encode(told))]
    for number in range(1, FULL_EVERY):
        state = AppState(1.0, 120 + number, {"x": 1.0 + number, "y": 2.0}, {"x": 1.0, "y": 2.0 - number, "sigma": 0.1})
        viewing.take("swarm/r1/app/localization/state", encode(state))
        sway = replace(
            TYPICAL_SAMPLES["balancer/state"], t=float(number), tilt=0.001 * number, battery=7.4 + 0.001 * number
        )
        viewing.take("swarm/r1/balancer/state", encode(sway))
        told = view(viewing, 3.0 * number)
        viewing.asked(WATCH, "r0", 3.0 * number)
        assert (told.services, set(told.values)) == ({}, {"app/localization/state"})
        sizes.append(len(encode(told)))
    assert sum(sizes) / len(sizes) + 100 < 1.1 * TYPICAL  # the packet with its key, tag and answer
    # One in a while has everything; what is too long is left out.
    viewing.take("swarm/r1/app/localization/state", encode(AppState(1.0, 1, {"x": "long" * 300}, {})))
    assert set(view(viewing, 3.0 * FULL_EVERY).values) == set(TYPICAL_SAMPLES) - {"app/localization/state"}


def test_who_comes_later_gets_everything_at_once() -> None:
    viewing = full()
    view(viewing, 0.0)
    assert view(viewing, 2.0).values == {}
    viewing.asked(WATCH, "r5", 3.0)
    assert set(view(viewing, 4.0).values) == set(TYPICAL_SAMPLES)


def test_a_service_that_is_gone_or_unwell_is_named() -> None:
    viewing = full()
    viewing.alive("swarm/r1/dwm/alive", False)
    degraded = Status(1.0, "balancer", "degraded", "the bus is slow " * 9, 1, 0.0, {})
    viewing.take("swarm/r1/balancer/status", encode(degraded))
    viewing.alive("swarm/r1/bus/alive", True)
    services = view(viewing, 0.0).services
    assert services["dwm"] == "gone"
    assert services["balancer"].startswith("degraded: the bus is slow")
    assert len(services["balancer"]) <= 80
    assert services["bus"] == "here"


def test_however_many_and_long_services_states_are_a_view_stays_small() -> None:
    viewing = full()
    for number in range(200):
        viewing.alive(f"swarm/r1/app/x{number}/alive", True)
        status = Status(1.0, f"app/x{number}", "\u20ac" * 15_000, "", 1, 0.0, {})
        viewing.take(f"swarm/r1/app/x{number}/status", encode(status))
    told: set[str] = set()
    for second in range(8):
        due = viewing.due(second * 2.0)
        assert due is not None
        assert len(due[1]) <= LARGEST + 100
        told |= decode(View, due[1], "swarm/r1/mesh/view").services.keys()
    assert len(told) > 20  # what had no room in one view is in a later one


@pytest.mark.parametrize("size", [0, 1000, MAX_PAYLOAD, 960_000])
def test_an_app_with_ever_new_names_fills_no_memory_and_takes_no_room_from_the_services(size: int) -> None:
    viewing = Viewing("r1", 6)
    viewing.asked(WATCH, "r0", 0.0)
    for number in range(2 * MAX_APP_KEYS):
        viewing.take(f"swarm/r1/app/x{number}/state", bytes(size))
    viewing.take("swarm/r1/dwm/pose", encode(TYPICAL_SAMPLES["dwm/pose"]))
    viewing.take("swarm/r1/mesh/clock", bytes(size))
    assert "dwm/pose" in view(viewing, 0.0).values
    assert len(viewing._values) <= MAX_APP_KEYS + 2
    assert sum(map(len, viewing._values.values())) <= MAX_APP_BYTES + 2 * MAX_PAYLOAD


def test_a_value_without_room_takes_the_older_one_with_it() -> None:
    viewing = full()
    viewing.take("swarm/r1/app/localization/state", bytes(MAX_PAYLOAD + 1))
    assert set(view(viewing, 0.0).values) == set(TYPICAL_SAMPLES) - {"app/localization/state"}


def test_the_services_that_are_told_of_are_limited() -> None:
    viewing = full()
    for number in range(2 * MAX_SERVICES):
        viewing.alive(f"swarm/r1/app/x{number}/alive", True)
        viewing.take(f"swarm/r1/app/x{number}/status", encode(Status(1.0, "x", "ready", "", 1, 0.0, {})))
    viewing.alive("swarm/r1/balancer/alive", False)
    assert (len(viewing._there), len(viewing._states)) == (MAX_SERVICES, MAX_SERVICES)
    assert view(viewing, 0.0).services["balancer"] == "gone"


def test_who_is_watched_gets_no_more_than_the_budget() -> None:
    for robots in (2, 8, 50, 100):
        viewing = Viewing("r1", robots)
        sent = 0
        for second in range(600):
            viewing.asked(Watch(1.0, LONGEST_S), "r0", float(second))
            sent += viewing.due(float(second)) is not None
        assert (sent - 1) * robots * TYPICAL <= 600 * BUDGET
        assert sent >= min(600, 600 * BUDGET / (robots * TYPICAL) - 1)


@given(st.lists(st.tuples(st.sampled_from([*KEYS, "mesh/watch"]), st.binary(max_size=30) | st.just(encode(WATCH)))))
def test_no_sample_harms_the_viewing(samples: list[tuple[str, bytes]]) -> None:
    viewing = full()
    for topic, payload in samples:
        viewing.take(f"swarm/r1/{topic.replace('*', 'x')}", payload)
        viewing.alive(f"swarm/{topic}/alive", False)
    due = viewing.due(0.0)
    assert due is not None
    assert len(due[1]) < LARGEST + 500


def test_a_view_crosses_the_mesh_to_the_watched_robot_and_not_in_anothers_name() -> None:
    world = World([("r0", "r1"), ("r1", "r2"), ("r2", "r3")])
    world.run(2.0)
    watch = encode(WATCH)
    world.step("r0", lambda each: each.flood("swarm/r0/mesh/watch", watch, BULK, world.now, latest=False))
    world.run(1.0)
    assert all(("swarm/r0/mesh/watch", watch) in world.bots[name].inbox for name in ("r1", "r2", "r3"))
    world.step("r3", lambda each: each.send("r0", "swarm/r3/mesh/view", b"v", BULK, world.now, latest=True))
    world.step("r3", lambda each: each.send("r0", "swarm/r2/mesh/view", b"v", BULK, world.now, latest=True))
    world.run(1.0)
    assert [key for key, _ in world.bots["r0"].inbox if key.endswith("/view")] == ["swarm/r3/mesh/view"]


@pytest.mark.slow
def test_real_meshes_send_views_of_their_robots(build: Build) -> None:
    swarm = build(edges=(("r0", "r1"), ("r1", "r2")), times=SHORT)
    told: dict[str, dict[str, object]] = {"r1": {}, "r2": {}}

    def hear(key: str, payload: bytes) -> None:
        view = decode(View, payload, key)
        told[key.split("/")[1]].update(view.values | view.services)

    swarm["r0"].bus.subscribe("swarm/*/mesh/view", hear)
    swarm.start()

    def all_told() -> bool:
        swarm["r0"].bus.publish("swarm/r0/mesh/set/watch", Watch(clock.now(), 3.0))
        swarm["r2"].bus.publish("swarm/r2/dwm/pose", TYPICAL_SAMPLES["dwm/pose"])
        return {"dwm/pose", "mesh/links", "mesh"} <= told["r2"].keys()

    wait_until(all_told, what="r2 tells r0")
    assert told["r2"]["mesh"] == "ready"
    assert "WARN" not in log_of(swarm["r2"].mesh)  # ended while it tells
