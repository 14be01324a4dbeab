"""What the app host gives to the app of its robot's measurements, replayed and live, and how a wait for them ends."""

import math
import random
import threading

import pytest
from apps_rig import NAMES, Rig
from conftest import wait_until
from host_rig import MakeRig, ask, make_rig, undisturbed
from memory_swarm import PLACES, TARGET
from test_absent import DROP, full, until_members

from swarm.errors import LocalError
from swarm.messages import AppEpoch, Measurement, Pose, Range, Ranges, Status
from swarm.messages.codec import decode, encode

__all__ = ["make_rig"]

REPLAY = '[apps.localization]\nalgorithm = "thesis"\n[dwm]\nsource = "replay:somewhere"\n'
LIVE = '[dwm]\nsource = "serial:/dev/null"\ntarget = "C933"\n'


def reading(name: str, k: int) -> Measurement:
    numbers = random.Random(f"{name} {k}")
    x, y = PLACES[int(name[1:])]
    return Measurement(float(k), k, math.dist((x, y), TARGET) + numbers.gauss(0, 0.02), x + numbers.gauss(0, 0.02), y)


def serve(rig: Rig) -> None:
    """What the dwm service of each robot does in a replay."""
    for name in rig.names:
        rig.buses[name].serve(
            f"swarm/{name}/dwm/measurement",
            lambda _, parameters, name=name: encode(reading(name, int(parameters["sequence"]))),
        )


def test_a_replay_takes_row_k_at_step_k_through_kills(make_rig: MakeRig) -> None:
    rig = make_rig(REPLAY)
    serve(rig)
    rig.gate = 20
    rig.start_all("localization", "--iterations", "80")
    rig.until_k(20)
    rig.kill("r1")
    rig.start("r1", "apps", "localization", "--iterations", "80")
    rig.gate = 80
    rig.until_phase("done")
    expected = undisturbed("localization", 80, {"algorithm": "thesis"}, measure=reading)
    for name in NAMES:
        assert rig.values(name, "localization") == expected[name]


def test_a_replay_waits_for_the_dwm_service_and_says_so(make_rig: MakeRig) -> None:
    rig = make_rig(REPLAY, ("r0", "r1"))
    rig.start_all("localization", "--iterations", "10")
    rig.until_phase("waiting")
    assert rig.progress["r0"].reason == "the dwm service gives no measurement"
    assert rig.progress["r0"].k == 0

    def told() -> tuple[str, str]:
        status = ask(rig, "r0", "localization/status", Status)
        return status.state, status.reason

    # Not by `rig.until`, whose lock the bus' thread takes before it can bring the answer.
    wait_until(lambda: told() == ("starting", rig.progress["r0"].reason), what="its status says it to systemd, too")
    serve(rig)
    rig.until_phase("done")


def test_live_measurements_are_the_newest_range_to_the_target_and_the_own_place(make_rig: MakeRig) -> None:
    rig = make_rig(LIVE, ("r0", "r1"))
    rig.start_all("localization", "--iterations", "30")
    rig.until_phase("waiting")
    serve_live(rig)
    rig.until_phase("done")
    rig.until_k(30)
    for name in rig.names:
        result = rig.state[name].result
        assert result["ambiguous"] is True
        candidates = ((result["x"], result["y"]), (result["other_x"], result["other_y"]))
        assert min(math.dist(candidate, TARGET) for candidate in candidates) < 1e-6


def serve_live(rig: Rig, *names: str) -> None:
    """Publish the reports of the dwm service of each robot, or of those that are named, once."""

    def ranges(name: str, distance: float, quality: int) -> Ranges:
        other = Range("D001", 9.0, 9.0, 100, 0.0, 1)
        return Ranges(0.0, 1, (other, Range("C933", distance, distance, quality, 0.1, 1)))

    for name in names or rig.names:
        x, y = PLACES[int(name[1:])]
        publish = rig.buses[name].publish
        publish(f"swarm/{name}/dwm/ranges", ranges(name, 7.0, 0))  # no quality: not used
        publish(f"swarm/{name}/dwm/pose", Pose(0.0, 1, 8.0, 8.0, None, 0, "none"))
        publish(f"swarm/{name}/dwm/ranges", b"\xc1 no message")
        publish(f"swarm/{name}/dwm/pose", Pose(0.0, 2, x, y, None, 90, "average"))
        publish(f"swarm/{name}/dwm/ranges", ranges(name, math.dist((x, y), TARGET), 80))


def test_a_robot_that_has_lost_its_state_says_so_without_waiting_for_a_measurement(make_rig: MakeRig) -> None:
    rig = make_rig(LIVE, ("r0", "r1"))
    states = {name: str(rig.directory / f"state.{name}") for name in rig.names}
    for name in rig.names:
        rig.start(name, "apps", "localization", SWARM_STATE=states[name])
    rig.until_phase("waiting")
    serve_live(rig)
    rig.until_k(5)
    rig.kill("r1")
    for file in (rig.directory / "r1").glob("app.*"):
        file.unlink()
    rig.start("r1", "apps", "localization", SWARM_STATE=states["r1"])
    reason = "r1 has lost its state and waits for the next epoch"
    rig.until(lambda: rig.progress["r1"].reason == reason, "a word of the lost state")


@pytest.mark.parametrize("how", ["rebooted", "restarted", "new"])
def test_a_robot_without_a_first_measurement_is_gone_on_without_until_it_has_one(make_rig: MakeRig, how: str) -> None:
    rig = make_rig(LIVE)
    full(rig)
    states = {name: str(rig.directory / f"state.{name}") for name in NAMES}
    for name in NAMES:
        rig.start(name, "apps", "localization", *DROP, SWARM_STATE=states[name])
    rig.until_phase("waiting")
    serve_live(rig, *NAMES[: 2 if how == "new" else 3])
    if how != "new":
        rig.until_k(5)
        rig.kill("r2")
        if how == "rebooted":
            until_members(rig, ("r0", "r1"), "r0", "r1")
            for file in (rig.directory / "r2").glob("app.*"):
                file.unlink()
        rig.start("r2", "apps", "localization", *DROP, SWARM_STATE=states["r2"])
    until_members(rig, ("r0", "r1"), "r0", "r1")
    rig.until(lambda: rig.progress["r2"].reason == "the dwm service gives no measurement", "a word of r2's module")
    for _ in range(2):  # longer than robots are taken in
        rig.until_k(rig.state["r0"].k + 50, "r0", "r1")
    assert rig.epochs["r0"].members == ("r0", "r1")
    serve_live(rig, "r2")
    until_members(rig, NAMES, *NAMES)
    rig.until_k(rig.state["r0"].k + 5)


def test_a_new_robot_that_comes_late_is_taken_in_when_it_has_a_measurement(make_rig: MakeRig) -> None:
    rig = make_rig(LIVE)
    full(rig)
    states = {name: str(rig.directory / f"state.{name}") for name in NAMES}
    for name in ("r0", "r1"):
        rig.start(name, "apps", "localization", *DROP, SWARM_STATE=states[name])
    rig.until(lambda: {"r0", "r1"} <= rig.progress.keys(), "a start")
    serve_live(rig, "r0", "r1")
    until_members(rig, ("r0", "r1"), "r0", "r1")
    told: list[AppEpoch] = []
    told_of = rig.buses["r0"].subscribe(
        "swarm/r0/app/localization/epoch", lambda key, payload: told.append(decode(AppEpoch, payload, key))
    )
    rig.start("r2", "apps", "localization", "--absent", "drop", "--drop-after", "3600", SWARM_STATE=states["r2"])
    rig.until(lambda: "r2" in rig.progress and rig.progress["r2"].phase == "waiting", "a word of r2's module")
    for _ in range(2):
        rig.until_k(rig.state["r0"].k + 50, "r0", "r1")
    told_of.close()
    # r0 and r1 may have made a further epoch: a busy machine holds up one of them for longer than the other waits.
    assert {epoch.members for epoch in (rig.epochs["r0"], *told)} == {("r0", "r1")}
    serve_live(rig, "r2")
    until_members(rig, NAMES, *NAMES)


def test_a_rebooted_robot_of_a_replay_is_taken_in_when_its_dwm_service_is_there(make_rig: MakeRig) -> None:
    rig, there = make_rig(REPLAY), threading.Event()
    full(rig)
    there.set()
    states = {name: str(rig.directory / f"state.{name}") for name in NAMES}

    def row(name: str, parameters: dict[str, str]) -> bytes:
        if name == "r2" and not there.is_set():
            raise LocalError("the service is still starting")
        return encode(reading(name, int(parameters["sequence"])))

    for name in NAMES:
        rig.buses[name].serve(f"swarm/{name}/dwm/measurement", lambda _, asked, name=name: row(name, asked))
        rig.start(name, "apps", "localization", *DROP, SWARM_STATE=states[name])
    rig.until_k(5)
    rig.kill("r2")
    until_members(rig, ("r0", "r1"), "r0", "r1")
    there.clear()
    for file in (rig.directory / "r2").glob("app.*"):
        file.unlink()
    rig.progress.pop("r2", None)  # it may have been killed before it told any
    rig.start("r2", "apps", "localization", *DROP, SWARM_STATE=states["r2"])
    rig.until(lambda: "r2" in rig.progress and rig.progress["r2"].phase == "waiting", "r2 waits")
    rig.until_k(rig.state["r0"].k + 50, "r0", "r1")
    there.set()
    until_members(rig, NAMES, *NAMES)


def test_sigterm_ends_an_app_that_waits_for_its_first_measurement(make_rig: MakeRig) -> None:
    rig = make_rig(LIVE, ("r0", "r1"))
    rig.start("r0", "apps", "localization")
    rig.until(lambda: "r0" in rig.progress, "a start")
    assert rig.stop("r0") == 0


def test_sigterm_ends_an_app_that_hangs_in_a_step(make_rig: MakeRig) -> None:
    rig = make_rig("", ("r0", "r1"))
    app = rig.directory / "lazy.py"
    app.write_text(
        "import threading\nfrom swarm import SyncApp\n"
        "class Lazy(SyncApp):\n    value: float\n    def step(self, neighbours):\n        threading.Event().wait()\n"
    )
    rig.start_all(str(app))
    rig.until_phase("running", "r0")
    assert rig.stop("r0") in (0, 3)
