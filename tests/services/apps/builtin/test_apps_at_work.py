"""The apps that blink, stand, talk and drive, under virtual time: the real hosts' cores, meshes and clients."""

import statistics
from itertools import groupby, pairwise
from types import SimpleNamespace

import pytest

from services.apps.builtin.goto import Goto, read_waypoints
from services.apps.builtin.stand_up import StandUp
from sim.virtual.run import run_virtually
from swarm.app.robot import Robot
from swarm.core.graph import Graph
from swarm.errors import AppError
from swarm.recording.run import Run

SIX = ("--robots", "6", "--topology", "line", "--jitter", "10ms")


def column(outcome, robot: str, name: str) -> list[float]:
    path = outcome.trajectories[robot]
    return [path.value(k, name) for k in sorted(path.rows)]


def results(report, name: str) -> list[object]:
    return [result[name] for result in report["result"].values()]


# -- led_sync


def test_leds_blink_together_by_mesh_time() -> None:
    frequencies = [f"r{i}.frequency_value={value}" for i, value in enumerate((1.8, 2.0, 2.1, 2.2, 2.3, 2.2))]
    report, _ = run_virtually(
        "led_sync", *SIX, "--seconds", "20", *[w for text in frequencies for w in ("--set", text)]
    )
    scene = report["scene"]
    assert scene["synchronous_after_s"] < 15
    assert scene["apart_neighbours_p95_ms"] < 10
    assert scene["apart_all_p95_ms"] < 20
    assert len(set(results(report, "frequency"))) == 1, "the same number, not only about the same"
    assert results(report, "frequency")[0] == pytest.approx(2.1, abs=4.1e-4)
    assert min(scene["flashes"].values()) > 20


def test_robots_with_clocks_of_their_own_blink_together_soon() -> None:
    """At the end of the line the first samples are 12 ms off, which would take half a minute to be slewed away."""
    report, _ = run_virtually("led_sync", *SIX, "--clock-skew", "30ppm", "--seconds", "25", "--seed", "1")
    assert report["scene"]["synchronous_after_s"] < 10
    assert report["scene"]["apart_all_p95_ms"] < 10


def test_algorithm_3_drifts_until_the_phase_is_zero() -> None:
    """Thesis 4.3.2, figure 4.6 (a): 2.1 Hz with a tolerance of 1/16 blinks with 2.2 Hz at first."""
    settings = [word for text in ("frequency_value=2.1", "phase_value=0.4", "overhead=0.0") for word in ("--set", text)]
    options = ("--robots", "3", "--topology", "full", *settings, "--seconds", "25")
    report, outcome = run_virtually("led_sync", "--algorithm", "thesis", *options, rows=True)
    for robot in ("r0", "r1", "r2"):
        phases = [phase for phase, _ in groupby(column(outcome, robot, "result.phase"))]
        steps = [after - before for before, after in pairwise(phases)]
        early = -statistics.median(steps[:15])  # by which each blink comes before the agreed time
        assert 1 / (1 / 2.1 - early) == pytest.approx(2.19, abs=0.01)
        assert max(phases[-20:]) < 1.5 / 16 / 2.1
        assert statistics.median(value for value in column(outcome, robot, "actual")[:60] if value > 0.0) == (
            pytest.approx(2.19, abs=0.01)
        )
    assert results(report, "frequency") == pytest.approx([2.1] * 3, abs=1e-6)


def test_a_frequency_that_no_led_shows_is_refused() -> None:
    report, _ = run_virtually("led_sync", "--robots", "2", "--seconds", "3", "--set", "r1.frequency_value=50")
    assert "expected 0.1 to 10 Hz, got 50" in report["problems"][0]


# -- stand_up


def test_robots_stand_up_one_after_the_other() -> None:
    report, _ = run_virtually(
        "stand_up", "--robots", "5", "--topology", "line", "--press", "r4.A@1s", "--seconds", "15"
    )
    scene = report["scene"]
    assert list(scene["stood_after_s"]) == ["r4", "r3", "r2", "r1", "r0"]
    assert set(scene["after_its_neighbour_s"]) == {"r3", "r2", "r1", "r0"}
    assert all(0.5 < gap < 6.0 for gap in scene["after_its_neighbour_s"].values())


@pytest.mark.parametrize("side", ["front", "back"])
def test_lying_robots_do_not_count_as_standing(side: str) -> None:
    report, _ = run_virtually("stand_up", "--robots", "3", "--lying", side, "--press", "r1.B@1s", "--seconds", "20")
    assert report["scene"]["lies"] == ["r0", "r1", "r2"]
    assert results(report, "standing") == [False] * 3
    assert results(report, "posture") == [side] * 3


@pytest.mark.parametrize(
    ("posture", "fault", "rises"),
    [("front", "", True), ("back", "", True), ("upright", "", True), ("front", "fell", False), ("standing", "", False),
     ("standing_up", "", False), ("leaning", "", False), ("unknown", "", False)],
)  # fmt: skip
def test_who_stands_up_when_a_neighbour_does(posture: str, fault: str, *, rises: bool) -> None:
    modes: list[str] = []
    devices = SimpleNamespace(posture=posture, fault=fault, mode=modes.append)
    app = StandUp(Robot("r0", Graph(("r0", "r1"), (("r0", "r1"),)), devices=devices))
    app.step([SimpleNamespace(name="r1", standing=False)])
    assert modes == []
    app.step([SimpleNamespace(name="r1", standing=True)])
    assert modes == ["stand"] * rises


def test_the_state_takes_one_byte() -> None:
    assert StandUp.spec.schema.size == 1


# -- flooding_demo and unicast_demo


def test_a_flood_is_heard_and_known_to_be_complete_everywhere() -> None:
    report, _ = run_virtually("flooding_demo", *SIX, "--press", "r0.A@1s", "--press", "r4.C@1s", "--seconds", "6")
    assert results(report, "floods") == [1, 0, 0, 0, 1, 0]
    assert results(report, "heard") == [1, 2, 2, 2, 1, 2]
    assert results(report, "complete") == [2] * 6
    assert results(report, "incomplete") == [0] * 6


def test_a_message_passes_over_robots_that_only_forward() -> None:
    """Figure 3.16: on a loop, r1 sends to r3, then r2 to r4."""
    options = ("--robots", "6", "--topology", "loop", "--press", "r1.B@1s", "--press", "r2.B@2s", "--seconds", "5")
    report, _ = run_virtually("unicast_demo", *options)
    assert results(report, "sent") == [0, 1, 1, 0, 0, 0]
    assert results(report, "delivered") == [0, 1, 1, 0, 0, 0]
    assert results(report, "received") == [0, 0, 0, 1, 1, 0]


def test_a_message_to_one_out_of_reach_is_lost_and_one_to_nobody_is_not_sent() -> None:
    options = ("--robots", "2", "--press", "r0.A@5s", "--press", "r1.B@5s", "--cut", "r0-r1@1s,40s", "--seconds", "25")
    report, _ = run_virtually("unicast_demo", *options)
    assert (results(report, "sent"), results(report, "delivered")) == ([1, 0], [0, 0])
    assert results(report, "received") == [0, 0]


# -- formation and goto


def test_four_form_a_wedge() -> None:
    options = ("--robots", "4", "--topology", "line", "--set", "shape=wedge", "--set", "size=0.4", "--seconds", "30")
    report, _ = run_virtually("formation", *options)
    assert report["scene"]["misfit_m"] < 0.05
    assert report["scene"]["closest_m"] > 0.15
    assert results(report, "known") == [3] * 4


def test_three_swap_sides_and_end_together() -> None:
    options = ("--robots", "3", "--topology", "line", "--set", "r0.waypoints=1.5,1.5 1.6,1.0",
               "--set", "r2.waypoints=0.5,1.5")  # fmt: skip
    report, _ = run_virtually("goto", *options)
    assert results(report, "reached") == results(report, "of") == [2, 1, 1]
    assert report["scene"]["closest_m"] > 0.15
    assert report["seconds"] < 60


@pytest.mark.slow
def test_six_cross_without_contact() -> None:
    report, _ = run_virtually("goto", "--robots", "6", "--topology", "line", "--jitter", "10ms")
    assert report["scene"]["contacts"] == 0
    assert all(result["reached"] == result["of"] for result in report["result"].values())


def test_the_same_seed_drives_the_same_way() -> None:
    first, second = (run_virtually("goto", "--robots", "3", "--iterations", "60", "--seed", "7")[0] for _ in range(2))
    assert first["scene"] == second["scene"]
    assert first["result"] == second["result"]


@pytest.mark.parametrize("text", ["1", "1,2,3", "a,b", "1,nan", "1,inf"])
def test_waypoints_that_are_none_are_refused(text: str) -> None:
    with pytest.raises(AppError, match="waypoints: "):
        read_waypoints(text)


def test_waypoints_are_read_from_their_text() -> None:
    assert read_waypoints("") == ((), False)
    assert read_waypoints("stay") == ((), True)
    assert read_waypoints("0.5,1.5 stay") == (((0.5, 1.5),), True)
    assert read_waypoints(" 0.5,1.5  -1,2e-1 ") == (((0.5, 1.5), (-1.0, 0.2)), False)


@pytest.mark.parametrize("waypoints", ["stay", "1,1 stay"])
def test_a_text_that_names_no_places_leaves_a_robot_where_it_is(waypoints: str) -> None:
    app = Goto(Robot("r0", Graph.of_shape("line", ["r0", "r1"])), {"waypoints": waypoints})
    app.robot.devices = SimpleNamespace(display=lambda lines: None)  # type: ignore[assignment]
    app.robot.recording = lambda name, t, value: None
    app.start()
    app._wish((1.0, 1.0))
    app.change({"waypoints": "0.5;1.5"})
    app.on_parameter("waypoints")
    assert app._stays
    assert app._wish((1.0, 1.0)) == (0.0, 0.0)


def test_a_robot_that_stands_at_its_next_waypoint_already_goes_on() -> None:
    app = Goto(Robot("r0", Graph.of_shape("line", ["r0", "r1"])), {"waypoints": "1,1 1,1 2,1"})
    app.robot.recording = lambda name, t, value: None
    app.start()
    for _ in range(3):
        wish = app._wish((1.0, 1.0))
    assert wish[0] > 0.0


def test_robots_that_are_to_stay_do_so_and_goto_goes_on_for_further_waypoints() -> None:
    options = ("--robots", "3", "--seconds", "20", "--set", "waypoints=stay", "--set", "r1.waypoints=1,1 stay")
    report, _ = run_virtually("goto", *options)
    assert results(report, "reached") == results(report, "of") == [0, 1, 0]
    assert (results(report, "x")[1], results(report, "y")[1]) == pytest.approx((1.0, 1.0), abs=0.15)
    assert report["seconds"] == pytest.approx(20.0, abs=0.5)


def test_goto_takes_new_waypoints_while_it_runs_and_keeps_the_old_ones_where_they_are_no_places() -> None:
    shown = list[str]()
    robot = SimpleNamespace(name="r0", swarm=("r0",), display=lambda *lines: shown.extend(lines))
    app = Goto.__new__(Goto)  # without the host's robot
    object.__setattr__(app, "robot", robot)
    object.__setattr__(app, "waypoints", "1,2 3,4")
    app.on_parameter("waypoints")
    assert app._goals == ((1.0, 2.0), (3.0, 4.0))
    object.__setattr__(app, "waypoints", "somewhere")
    app.on_parameter("waypoints")
    assert app._goals == ((1.0, 2.0), (3.0, 4.0))
    assert shown == ["waypoints", "not read"]


def test_what_an_app_records_is_in_the_recording(tmp_path) -> None:
    """The timeline of a flood: sent, heard everywhere, known to be complete (thesis figure 3.13)."""
    run_virtually("flooding_demo", *SIX, "--press", "r0.A@1s", "--seconds", "3", "--record", str(tmp_path / "run"))
    run = Run(tmp_path / "run")
    told = {(s.topic.split("/")[1], s.topic.split("/")[-1]): s for s in run.samples("swarm/*/app/*/record/*")}
    assert set(told) == {("r0", "sent"), ("r0", "took"), *((name, "complete") for name in run.robots)} | {
        (name, "heard") for name in run.robots if name != "r0"
    }
    assert told["r0", "sent"].message["value"] == "r0 says a 1"
    heard = [told[name, "heard"].t for name in run.robots[1:]]
    assert told["r0", "sent"].t < heard[0] < heard[1] < heard[2] < heard[3] < heard[4] < told["r0", "complete"].t
    assert 0.25 < told["r0", "took"].message["value"] < 0.6
