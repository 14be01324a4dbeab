"""The links of a run: those in force when it began, through kills and through changes."""

import gc
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from apps_rig import Rig
from conftest import wait_until
from host_rig import START, MakeRig, make_rig
from memory_swarm import config_of

from services.apps.host import topology
from services.apps.host.topology import CONFIGURED, SETTLED, TopologyWatch, lacking
from services.apps.persistence import run_file
from swarm.core.lockstep.frames import Channel
from swarm.messages import Topology
from swarm.messages.codec import encode

__all__ = ["make_rig"]

STAR = (("r0", "r2"), ("r1", "r2"))
START_VALUES = {"r0": 0.5, "r1": 3.0, "r2": 5.0}


def told(*edges: tuple[str, str], version: int = 1, auto: bool = False, since: float = 0.0, near: str = "") -> Topology:
    return Topology(0.0, version, 0, "r0", auto, since, edges, tuple(near.split()), (), (), {})


def value(rig: Rig, name: str, k: int) -> float:
    wait_until(lambda: k in rig.rows(name), what=f"{name} has recorded iteration {k}")
    return float(rig.rows(name)[k].split(",")[1])


def test_a_run_begins_on_the_topology_in_force_and_keeps_it(make_rig: MakeRig) -> None:
    rig = make_rig(START)
    rig._relay("r0", "r2")
    rig._relay("r2", "r0")
    rig.set_topology(*STAR)
    rig.gate = 3
    rig.start_all("consensus", "--iterations", "40")
    rig.until_k(3)
    # Metropolis weights of the star: 1/3 on each link.
    x = START_VALUES
    assert value(rig, "r2", 1) == pytest.approx(x["r2"] + (x["r0"] - x["r2"]) / 3 + (x["r1"] - x["r2"]) / 3)
    assert value(rig, "r0", 1) == pytest.approx(x["r0"] + (x["r2"] - x["r0"]) / 3)
    # The topology of the configuration is back, one host is killed: it goes on as it began.
    rig.set_topology(("r0", "r1"), ("r1", "r2"))
    rig.kill("r0")
    rig.start("r0", "apps", "consensus", "--iterations", "40")
    rig.until_waits("r0", "r2")
    reason = "topology 2 has no link with r0, which this run needs: set one that has it, or start a new run"
    rig.until(lambda: rig.progress["r2"].reason == reason, "the reason is told")
    assert rig.progress["r2"].phase == "waiting"
    rig.set_topology(*STAR)
    rig.gate = 2**32
    rig.until_phase("done")
    assert value(rig, "r0", 40) == pytest.approx(sum(x.values()) / 3, abs=1e-3)


def test_hosts_on_other_links_never_mix_and_say_so(make_rig: MakeRig) -> None:
    rig = make_rig(START)
    rig._relay("r0", "r2")
    rig._relay("r2", "r0")
    rig.start("r0", "apps", "consensus", "--iterations", "40")
    rig.start("r1", "apps", "consensus", "--iterations", "40")
    rig.until_waits("r1", "r2")
    rig.set_topology(("r0", "r1"), ("r1", "r2"), ("r0", "r2"))
    rig.start("r2", "apps", "consensus", "--iterations", "40")
    reason = "r2 began on other links: start a new run, with another number"
    rig.until(lambda: rig.progress["r1"].reason == reason, "r1 says why")
    assert rig.progress["r1"].k <= 1
    for name in rig.names:
        rig.stop(name)
        rig.start(name, "apps", "consensus", "--iterations", "40", "--run", "77")
    rig.until_phase("done")
    assert value(rig, "r0", 1) == pytest.approx(sum(START_VALUES.values()) / 3)


# -- its parts ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("topology", "reason"),
    [
        (told(*STAR), ""),
        (told(("r0", "r1"), auto=True), "the automatic topology does not link all robots yet, not r2"),
        (told(auto=True), "the automatic topology does not link all robots yet, not r1 r2"),
        (told(*STAR, auto=True, since=100.0 - SETTLED + 0.1), "the automatic topology has just changed"),
        (told(*STAR, auto=True, since=100.0 - SETTLED), ""),
        (told(*STAR, since=99.9), ""),
    ],
)
def test_when_a_run_can_begin(topology: Topology, reason: str) -> None:
    assert lacking(config_of(3), topology, 100.0) == reason


def test_the_epoch_tells_links_apart() -> None:
    config = config_of(3)
    line, star, other = (
        topology.of_edges(config, edges) for edges in (config.edges, STAR, (("r0", "r1"), ("r1", "r2"), ("r0", "r2")))
    )
    assert line.epoch == CONFIGURED
    assert len({line.epoch, star.epoch, other.epoch}) == 3
    assert topology.of_edges(config, STAR[::-1]).epoch == star.epoch
    assert star.config.neighbours("r2") == ("r0", "r1")


def test_what_is_kept_belongs_to_one_run(runtime) -> None:
    config = config_of(3)
    links = topology.of_edges(config, STAR)
    path = runtime / "app.consensus.topology"
    topology.save(runtime, "consensus", 2**64 - 1, links)
    kept = run_file.read(topology._Kept, path, 2**64 - 1, "")
    assert kept is not None
    assert kept.edges == STAR
    assert run_file.read(topology._Kept, path, 7, "") is None
    path.write_bytes(path.read_bytes()[:-1])
    assert run_file.read(topology._Kept, path, 2**64 - 1, "") is None
    assert run_file.read(topology._Kept, runtime / "none", 7, "") is None


def test_only_a_missing_link_that_is_waited_for_is_a_reason() -> None:
    lost: list[str] = []
    ours = Channel(1, 5, 1, 3)
    watch = TopologyWatch(("r0", "r1"), lost.append)
    watch.take(told(*STAR, near="r0 r1"))
    assert watch.reason(("r0", "r1")) == ""
    for _ in range(3):
        watch.take(told(("r0", "r1"), ("r1", "r2"), version=3, near="r1"))
    assert len(lost) == 1
    assert watch.reason(("r1",)) == ""
    assert watch.reason(("r0", "r1")).startswith("topology 3 has no link with r0")
    watch.heard("r1", Channel(1, 6, 1, 3), ours)
    assert watch.reason(("r0", "r1")).startswith("r1 began on other links")
    watch.heard("r1", ours, ours)
    watch.take(told(*STAR, version=4, near="r0 r1"))
    assert watch.reason(("r0", "r1")) == ""


def test_a_run_that_waits_for_a_topology_keeps_only_the_newest_answer(tmp_path: Path) -> None:
    """It may wait for days until a robot is switched on."""
    config = config_of(3)

    class Answers:
        publish = staticmethod(lambda *_: None)

        @staticmethod
        def ask(name: str, on_reply: Callable[[str, bytes], None], **_: object) -> None:
            for _ in range(100):
                on_reply(name, encode(told(("r0", "r1"))))

    rounds = iter([False, False, True])
    stopping = SimpleNamespace(wait=lambda _: next(rounds))
    waits: list[str] = []
    service: Any = SimpleNamespace(
        runtime=tmp_path, config=config, robot="r0", bus=Answers, stopping=stopping, waits=waits.append
    )
    kept: list[int] = []

    def look(*_: object) -> str:
        gc.collect()
        kept.append(sum(isinstance(each, Topology) for each in gc.get_objects()))
        return "not yet"

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(topology, "lacking", look)
        patch.setattr(topology, "TELL_EVERY", 0.0)
        assert topology.of_run(service, "x", 7) is None
    assert len(kept) == 3
    assert kept[-1] <= kept[0]
    assert set(waits) == {"not yet"}, "systemd knows why the app is not ready"


def test_after_a_change_of_members_the_run_needs_the_links_of_the_new_ones() -> None:
    lost: list[str] = []
    watch = TopologyWatch(("r0", "r1"), lost.append)
    watch.take(told(*STAR, near="r0 r1"))
    watch.need(("r1", "r3"))
    watch.take(told(*STAR, version=5, near="r1 r3"))
    assert lost == []
    watch.take(told(*STAR, version=6, near="r1"))
    assert watch.reason(("r3",)).startswith("topology 6 has no link with r3")
