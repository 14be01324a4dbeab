"""Several locksteps in one app, and several apps on one robot: none touches another."""

import signal
from types import SimpleNamespace

import pytest
from apps_rig import NAMES, Rig
from host_rig import MakeRig, ask, consensus, make_rig

from services.apps.host.host import LockstepHost
from services.apps.host.lockstep_driver import CLOSE_WITHIN
from swarm.messages import AppState

__all__ = ["make_rig"]


def test_steps_that_hang_are_waited_for_all_together_when_the_process_ends() -> None:
    """systemd kills it after 5 s."""

    class Driver:
        def close(self, within: float) -> None:
            runtime.now += within

    runtime = SimpleNamespace(now=100.0)
    host = LockstepHost.__new__(LockstepHost)
    vars(host).update(_claims=None, _runtime=runtime, drivers={str(number): Driver() for number in range(8)})
    host.close(CLOSE_WITHIN)
    assert runtime.now - 100.0 < 3.0
    host.close()
    assert runtime.now - 100.0 < 6.0


PAIR = """
import sys
from services.apps import loader
from services.apps.host import topology
from services.apps.persistence.claim import AppLock
from services.apps.host.host import LockstepHost, Part
from services.apps.host.topology import RunPlace
from services.apps.runner import Runner
from services.apps.persistence.storage import FileStorage
from swarm.app.run_options import RunOptions
from swarm.process.service import Service, run
from swarm.process.threads import ThreadedRuntime

def main():
    fast, slow = (loader.load(path) for path in sys.argv[1:])
    with Service("app/pair") as service:
        links = topology.of_run(service, "pair", 7)
        topology.save(service.runtime, "pair", 7, links)
        parts = [
            Part(name, Runner(app.make(service.config, service.robot), app.source))
            for name, app in (("a", fast), ("b", slow))
        ]
        claim = AppLock(service.runtime, "pair", service.runtime)
        place = RunPlace.of(7, b"1", RunOptions(50), links.config, links.epoch, claim.incarnation)
        runtime = ThreadedRuntime(service)
        host = LockstepHost(runtime, "pair", parts, place, FileStorage(service.runtime), None)
        runtime.entry(host.start)()
        service.stopping.wait()
        host.close()
        return 3 if host.failed else 0

run(main)
"""

COUNTER = """
from swarm import SyncApp

class Counter(SyncApp):
    value: float

    def step(self, neighbours):
        if "{trap}" == self.robot.name and self.k == 5:
            raise ValueError("no more")
        self.value += sum(n.value for n in neighbours) + 1
"""


def phase(rig: Rig, name: str, channel: str, wanted: str) -> None:
    key = f"swarm/{name}/app/pair/{channel}/progress"
    rig.until(lambda: key in rig.told and rig.told[key].phase == wanted, f"{key} {wanted}")


@pytest.mark.slow
def test_two_channels_of_one_app_never_mix(make_rig: MakeRig) -> None:
    """The same class twice, one of them in fault on one robot: the other goes to its end, kills and all."""
    rig = make_rig("")
    for file, trap in (("good", ""), ("bad", "r2")):
        (rig.directory / f"{file}.py").write_text(COUNTER.format(trap=trap))
    (rig.directory / "pair.py").write_text(PAIR)
    command = [str(rig.directory / f"{file}.py") for file in ("pair", "good", "bad")]
    rig.gate = 20
    for name in NAMES:
        rig.launch(name, "apps", command)
    phase(rig, "r2", "b", "fault")
    assert rig.told["swarm/r2/app/pair/b/progress"].reason.endswith("line 9: ValueError: no more")
    phase(rig, "r1", "a", "waiting")
    rig.kill("r0")
    rig.launch("r0", "apps", command)
    rig.gate = 2**32
    for name in NAMES:
        phase(rig, name, "a", "done")
    phase(rig, "r1", "b", "waiting")
    assert rig.told["swarm/r1/app/pair/b/progress"].waiting_for == ("r2",)
    ends = {name: ask(rig, name, "pair/a/state", AppState) for name in NAMES}
    assert {state.k for state in ends.values()} == {50}
    assert ends["r0"].state == ends["r2"].state != ends["r1"].state
    assert ask(rig, "r1", "pair/b/state", AppState).k == 6
    assert [rig.stop(name) for name in NAMES] == [0, 0, 3]


def told(rig: Rig, name: str, app: str) -> str:
    progress = rig.told.get(f"swarm/{name}/app/{app}/progress")
    return "" if progress is None else progress.phase


def test_two_apps_on_one_robot(make_rig: MakeRig) -> None:
    """One is killed, and one robot's is stopped for good: the other never notices."""
    rig = make_rig()
    (rig.directory / "other.py").write_text(COUNTER.format(trap=""))
    rig.gate = 10
    rig.start_all("consensus", "--iterations", "40")
    for name in NAMES:
        rig.launch(name, "other", ["-m", "services.apps", str(rig.directory / "other.py"), "--iterations", "40"])
    rig.until(lambda: all(f"swarm/{n}/app/other/progress" in rig.told for n in NAMES), "both have begun")
    rig.kill("r1", "other")
    rig.processes["r2", "other"].send_signal(signal.SIGSTOP)
    rig.gate = 2**32
    rig.until(lambda: all(told(rig, n, "consensus") == "done" for n in NAMES), "one is done")
    for name, rows in consensus(40).items():
        assert rig.values(name) == rows
    assert told(rig, "r0", "other") != "done"
    rig.launch("r1", "other", ["-m", "services.apps", str(rig.directory / "other.py"), "--iterations", "40"])
    rig.processes["r2", "other"].send_signal(signal.SIGCONT)
    rig.until(lambda: all(told(rig, n, "other") == "done" for n in NAMES), "the other too")
    assert rig.values("r0", "other")[-1] == rig.values("r2", "other")[-1]


def test_robots_with_other_sources_are_named(make_rig: MakeRig) -> None:
    """Under one run number and under numbers of their own; with the right file the run goes on."""
    rig = make_rig("")
    for name in NAMES:
        (rig.directory / name / "count.py").write_text(COUNTER.format(trap="") + "\n" * (name == "r2"))

    def start(name: str, source: str, **environment: str) -> None:
        rig.start(name, "apps", str(rig.directory / source / "count.py"), "--iterations", "5", **environment)

    for name in NAMES:
        start(name, name, SWARM_RUN="5")
    for name, other in (("r1", "r2"), ("r2", "r1")):
        rig.until_waits(name, other)
        assert rig.progress[name].reason == f"{other} runs another version of this app"
    rig.stop("r2")
    start("r2", "r2")
    reason = "r2 is in another run: another number, other sources of the app, or another swarm.toml"
    rig.until(lambda: rig.progress["r1"].reason == reason, "the other run is named")
    rig.stop("r2")
    start("r2", "r0", SWARM_RUN="5")
    rig.until_phase("done")
