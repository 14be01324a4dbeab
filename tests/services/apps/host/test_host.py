"""The app host as processes on real buses: runs, kills, restarts, faults. Trajectories are compared bit for bit."""

import ctypes
import os
import platform
import signal
from dataclasses import replace
from pathlib import Path

import pytest
from apps_rig import NAMES, Rig, config_text
from conftest import wait_until
from host_rig import START, MakeRig, ask, consensus, make_rig
from memory_swarm import config_of

from services.apps import loader
from services.apps.host.host import schema_of
from services.apps.runner import Runner
from swarm.config import load
from swarm.core.lockstep.frames import Channel
from swarm.messages import AppProgress, AppState, Links, LinkState, Status
from swarm.recording.run import Run

__all__ = ["make_rig"]


def test_a_run_to_its_end_and_the_result_stays_to_be_read(make_rig: MakeRig) -> None:
    rig = make_rig()
    rig.start_all("consensus", "--iterations", "60")
    rig.until_phase("done")
    rig.until_k(60)
    for name, rows in consensus(60).items():
        assert rig.values(name) == rows
        assert ask(rig, name, "consensus/state", AppState).k == 60
        assert ask(rig, name, "consensus/progress", AppProgress).phase == "done"
        assert ask(rig, name, "consensus/status", Status).state == "ready"
        assert rig.state[name].result["value"] == pytest.approx(8.5 / 3)
    assert [rig.stop(name) for name in NAMES] == [0, 0, 0]
    assert [rig.log(name) for name in NAMES] == ["", "", ""]


@pytest.mark.parametrize("victims", [("r1",), ("r0", "r2"), NAMES])
def test_a_killed_app_goes_on_where_it_was(make_rig: MakeRig, victims: tuple[str, ...]) -> None:
    """kill -9 in mid-run, one robot, two and all: the trajectory is that of the undisturbed run."""
    rig = make_rig()
    rig.gate = 15
    rig.start_all("consensus", "--iterations", "60")
    rig.until_k(15)
    for name in victims:
        rig.kill(name)
    for name in victims:
        rig.start(name, "apps", "consensus", "--iterations", "60")
    rig.gate = 60
    rig.until_phase("done")
    for name, rows in consensus(60).items():
        assert rig.values(name) == rows
    for name in victims:
        assert "goes on at iteration 1" in rig.log(name)


def test_kills_at_any_moment_change_no_value_of_a_run(make_rig: MakeRig) -> None:
    """The middle robot is killed again and again while the swarm runs freely."""
    rig = make_rig()
    rig.start_all("consensus", "--iterations", "600")
    for k in (5, 150, 300):
        rig.until_k(k, "r1")
        rig.kill("r1")
        rig.start("r1", "apps", "consensus", "--iterations", "600")
    rig.until_phase("done")
    for name, rows in consensus(600).items():
        assert rig.values(name) == rows


def test_a_killed_bus_is_survived(make_rig: MakeRig) -> None:
    rig = make_rig(own_bus=("r1",))
    rig.gate = 15
    rig.start_all("consensus", "--iterations", "60")
    rig.until_k(15)
    rig.kill("r1", "bus")
    rig.gate = 60
    rig.start("r1", "bus")
    rig.until_phase("done")
    for name, rows in consensus(60).items():
        assert rig.values(name) == rows


def test_a_stopped_robot_is_named_and_waited_for(make_rig: MakeRig) -> None:
    rig = make_rig()
    rig.gate = 10
    rig.start_all("consensus", "--iterations", "40")
    rig.until_k(10)
    rig.processes["r2", "apps"].send_signal(signal.SIGSTOP)
    rig.gate = 40
    rig.until_waits("r1", "r2")
    rig.processes["r2", "apps"].send_signal(signal.SIGCONT)
    rig.until_phase("done")
    for name, rows in consensus(40).items():
        assert rig.values(name) == rows


def test_a_robot_alone_runs_too(make_rig: MakeRig) -> None:
    rig = make_rig("[apps.consensus]\nvalue = 4.0\n", ("r0",))
    rig.start_all("consensus", "--iterations", "5")
    rig.until_phase("done")
    assert rig.values("r0") == ["4.0,4.0"] * 6


def test_frames_that_cannot_be_used_are_counted(make_rig: MakeRig) -> None:
    rig = make_rig("", ("r0", "r1"))
    rig.start("r0", "apps", "consensus", SWARM_RUN="a1")
    rig.until_phase("waiting", "r0")
    app = loader.load("consensus")
    schema = f"{schema_of(Runner(app.make(config_of(2), 'r0'), app.source), '', app.digest):08x}"
    channel = f"swarm/r1/app/consensus/sync/{0xA1:016x}-0-1-{schema}"
    other = f"swarm/r1/app/consensus/sync/{0xA2:016x}-0-1-{schema}"
    frames = [
        (other, b"a frame of another run"),
        (channel, b"what is this"),
        (f"{channel}/r7", b"not for us"),
        ("swarm/r1/app/consensus/sync/no-channel", b"x"),
        (f"{channel}/r0/x", b"no frame's key"),
    ]
    for name, data in frames:
        rig.buses["r0"].publish(name, data)
    rig.buses["r0"].publish("swarm/r0/mesh/links", b"no links at all")
    counters: dict[str, int] = {}

    def counted() -> bool:
        counters.update(ask(rig, "r0", "consensus/status", Status).counters)
        return {"sync_other_run", "sync_malformed", "refused_keys", "refused_payloads"} <= set(counters)

    wait_until(counted)
    assert (counters["sync_other_run"], counters["sync_malformed"], counters["refused_keys"]) == (1, 1, 2)


def test_a_renewed_link_is_a_reason_to_ask_at_once(make_rig: MakeRig) -> None:
    """The news of the link is heard and repeated samples of it are not news; the run ends as it should."""
    rig = make_rig()
    rig.gate = 5
    rig.start_all("consensus", "--iterations", "20")
    rig.until_k(5)
    rig.gate = 20
    link = LinkState("r1", "up", 2, 0.0, 0, 0, "")
    for _ in range(3):
        rig.buses["r0"].publish("swarm/r0/mesh/links", Links(0.0, (link,)))
    rig.buses["r0"].publish("swarm/r0/mesh/links", b"no links at all")
    rig.until_phase("done")
    assert rig.values("r0") == consensus(20)["r0"]
    assert ask(rig, "r0", "consensus/status", Status).counters["refused_payloads"] == 1


def test_a_silent_link_is_gone_around(make_rig: MakeRig) -> None:
    rig = make_rig()
    rig.gate = 5
    rig.start_all("consensus", "--iterations", "20")
    rig.until_k(5)
    rig.silent, rig.gate = True, 20
    rig.until_phase("done")
    assert rig.values("r0") == consensus(20)["r0"]
    # More than once where the neighbour was slow before, was taken for silent, and was then heard over the link.
    wait_until(lambda: ask(rig, "r0", "consensus/status", Status).counters.get("sync_links_gone_around", 0) >= 1)


def test_another_run_begins_anew(make_rig: MakeRig) -> None:
    rig = make_rig()
    for run, last in (("a1", 20), ("a2", 10)):
        rig.start_all("consensus", "--iterations", str(last), SWARM_RUN=run)
        rig.until(
            lambda last=last: all(
                n in rig.progress and rig.progress[n].phase == "done" and rig.progress[n].k == last for n in NAMES
            ),
            f"run {run}",
        )
        for name in NAMES:
            assert rig.values(name) == consensus(last)[name]
            assert rig.stop(name) == 0
    assert "the snapshot is of another run, this one begins anew" in rig.log("r0")


def test_the_same_run_again_is_at_its_end_at_once(make_rig: MakeRig) -> None:
    """Alone, the others gone: it knows that they were at the end, and answers with its result."""
    rig = make_rig()
    rig.start_all("consensus", "--iterations", "20")
    rig.until_phase("done")
    before = rig.rows("r0")
    for name in NAMES:
        rig.stop(name)
    rig.progress.clear()
    rig.start("r0", "apps", "consensus", "--iterations", "20")
    rig.until_phase("done", "r0")
    assert rig.rows("r0") == before


def test_a_second_process_of_an_app_is_refused(make_rig: MakeRig) -> None:
    rig = make_rig()
    rig.start("r0", "apps", "consensus")
    rig.until(lambda: "r0" in rig.progress, "a start")
    first = rig.processes["r0", "apps"]
    second = rig.start("r0", "apps", "consensus")
    assert second.wait(60) == 2
    assert "another process runs app consensus on this robot" in rig.log("r0")
    assert "Traceback" not in rig.log("r0")
    assert first.poll() is None
    first.terminate()
    assert first.wait(60) == 0


def test_an_app_stops_that_hears_of_a_newer_process_of_its_own(make_rig: MakeRig) -> None:
    """A lock keeps a second one from starting; where that fails, each says that it is there."""
    rig = make_rig("", ("r0", "r1"))
    said: list[tuple[str, bytes]] = []
    rig.buses["r0"].subscribe("swarm/r0/app/consensus/sync/**", lambda key, payload: said.append((key, payload)))
    rig.start("r0", "apps", "consensus", SWARM_RUN="a1")
    wait_until(lambda: bool(said))
    name, frame = said[0]
    sync, channel = name.rsplit("/", 1)
    newer = replace(Channel.parse(channel), incarnation=2)
    assert (sync, Channel.parse(channel).incarnation) == ("swarm/r0/app/consensus/sync", 1)
    rig.buses["r0"].publish(f"{sync}/{newer.text}", frame)
    rig.until_phase("fault", "r0")
    assert "another process runs this app on r0" in rig.progress["r0"].reason


def test_an_app_that_raises_is_named_and_the_others_wait_for_it(make_rig: MakeRig) -> None:
    rig = make_rig("[apps.grumpy]\nat = 7\n")
    app = rig.directory / "grumpy.py"
    app.write_text(
        "from swarm import SyncApp, parameter\n"
        "class Grumpy(SyncApp):\n"
        "    value: float\n"
        "    at: int = parameter(0)\n"
        "    def step(self, neighbours):\n"
        "        if self.robot.name == 'r2' and self.k == self.at:\n"
        "            raise ValueError('I will not')\n"
    )
    rig.start_all(str(app))
    rig.until_phase("fault", "r2")
    assert rig.progress["r2"].k == 7
    assert rig.progress["r2"].reason == f"Grumpy on r2, iteration 7: {app}, line 7: ValueError: I will not"
    assert ask(rig, "r2", "grumpy/status", Status).state == "degraded"
    rig.until_waits("r1", "r2")
    assert rig.stop("r2") == 3
    assert rig.stop("r1") == 0
    assert "Traceback" not in rig.log("r2")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("nothing",), "there is no app 'nothing': expected consensus, flooding_demo, "),
        (("consensus", "--run", "xyz"), "--run or SWARM_RUN: expected a hexadecimal number of 64 bits, got 'xyz'"),
        (("consensus", "--iterations", "-1"), "expected a whole number from 0 to 4294967295"),
        (("localization",), "[dwm] target: expected the address of the target's module, this app needs it"),
        (("wrong.py",), "wrong.py, line 1: ModuleNotFoundError: No module named 'nothing'"),
        (("consensus",), "app consensus on r0: unknown parameter 'valeu'; Consensus has weights, diverges_above,"),
    ],
)
def test_wrong_starts_are_one_line_and_exit_2(runtime: Path, arguments: tuple[str, ...], message: str) -> None:
    (runtime / "wrong.py").write_text("import nothing\n")
    arguments = tuple(str(runtime / a) if a.endswith(".py") else a for a in arguments)
    rig = Rig.__new__(Rig)  # without buses: the process must not need one to refuse
    rig.directory, rig.records, rig.processes = runtime, runtime, {}
    (runtime / "swarm.toml").write_text(config_text(more="[apps.consensus]\nvaleu = 1.0\n"))
    (runtime / "r0").mkdir()
    assert rig.start("r0", "apps", *arguments).wait(60) == 2
    assert message in rig.log("r0")
    assert "Traceback" not in rig.log("r0")


def test_a_recording_knows_what_was_set(make_rig: MakeRig) -> None:
    rig = make_rig()
    rig.start_all("consensus", "--iterations", "5", "--set", "r1.value=9", "--set", "weights=row")
    rig.until_phase("done")
    for name in NAMES:
        rig.stop(name)
    recorded = load(rig.records / "swarm.toml").app("consensus")
    assert [recorded.of(name) for name in NAMES] == [{"value": x, "weights": "row"} for x in (0.5, 9, 5.0)]
    run = Run(rig.records)
    parameters = {s.topic.split("/")[1]: s.message["parameters"] for s in run.samples("**/parameters")}
    assert {name: found["weights"]["value"] for name, found in parameters.items()} == dict.fromkeys(NAMES, "row")


def test_old_recordings_make_room_for_new_ones(make_rig: MakeRig) -> None:
    rig = make_rig(START + "[recordings]\nbudget = 5e4\n")
    state = rig.directory / "state"
    old = state / "runs" / "consensus-0000000000000001"
    old.mkdir(parents=True)
    (old / "r0.consensus.mcap").write_bytes(bytes(100_000))
    for path in (old, *old.iterdir()):
        os.utime(path, (1e9, 1e9))
    words = ("apps", "consensus", "--iterations", "5", "--run", "2")
    rig.start("r0", *words, "--record", SWARM_STATE=str(state), SWARM_RECORD="")
    for name in NAMES[1:]:
        rig.start(name, *words)
    rig.until_phase("done")
    assert [path.name for path in (state / "runs").iterdir()] == ["consensus-0000000000000002"]
    assert "consensus-0000000000000001 is deleted" in rig.log("r0")


def test_a_full_disk_for_the_recording_does_not_stop_the_run(make_rig: MakeRig) -> None:
    rig = make_rig()
    rig.start_all("consensus", "--iterations", "20", SWARM_RECORD="/dev/full")
    rig.until_phase("done")
    assert ask(rig, "r0", "consensus/status", Status).counters["records_lost"] >= 21
    assert rig.log("r0").count("cannot be recorded, the run goes on") == 1


def test_sigterm_is_heard_whichever_thread_it_hits(make_rig: MakeRig) -> None:
    """The kernel may hand it to one of Zenoh's threads while the main one sleeps."""
    rig = make_rig("", ("r0", "r1"))
    process = rig.start("r0", "apps", "consensus")
    rig.until(lambda: "r0" in rig.progress, "a start")
    threads = [int(entry.name) for entry in Path(f"/proc/{process.pid}/task").iterdir()]
    # tgkill(2) by its number: signals to one thread of another process have no call in Python.
    number = {"x86_64": 234, "aarch64": 131}.get(platform.machine())
    if number is None:
        pytest.skip("the number of tgkill(2) on this machine is not known here")
    assert ctypes.CDLL(None).syscall(number, process.pid, max(threads), signal.SIGTERM) == 0
    assert process.wait(60) == 0
