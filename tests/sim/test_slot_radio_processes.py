"""`swarm sim --radio slots` with real processes: one of them is the radio of all robots."""

import os
import signal
from functools import cache

import fork_server
import pytest
from conftest import wait_until

from bench.rigs.simulation import Simulation
from sim.control.link_cuts import cut_link
from sim.virtual.run import run_virtually
from swarm.process.simulations import pid_of

FORKED = {"program": ("laptop.cli.runs.sim",), "start": fork_server.start}
THESIS = ("consensus", "--robots", "6", "--topology", "thesis-d", "--radio", "slots", "--iterations", "60")
LINE = ("consensus", "--robots", "3", "--radio", "slots", "--iterations", "400")

pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]


@cache
def undisturbed(*run: str):
    """The trajectories of the same run under virtual time."""
    return run_virtually(*run, rows=True)[1].trajectories


def is_undisturbed(simulation: Simulation, *run: str) -> bool:
    return all(simulation.trajectory(name).rows == path.rows for name, path in undisturbed(*run).items())


@pytest.mark.parametrize("links", ["auto", "graph"])
def test_six_robots_on_the_thesis_graph_end_as_under_virtual_time_bit_for_bit(links: str) -> None:
    run = (*THESIS, "--links", links)
    with Simulation(*run, **FORKED) as simulation:
        report = simulation.finish()
        assert report["problems"] == []
        assert report["restarts"] == 0
        assert is_undisturbed(simulation, *run)
        # Each value crosses the radio at least once.
        assert report["radio"]["frames"] >= report["messages"] / 2


def test_nothing_that_happens_to_the_radio_its_links_or_a_hub_changes_a_bit() -> None:
    with Simulation(*LINE, "--kill", "r0.mesh@1s", "--cut", "r0-r1@3s,2s", **FORKED) as simulation:
        simulation.wait_for("r0", 150)
        pid = pid_of(simulation.run_dir, "radio", "radio")
        assert pid is not None
        os.kill(pid, signal.SIGKILL)
        simulation.wait_for("r0", 200)
        wait_until(lambda: pid_of(simulation.run_dir, "radio", "radio") not in (None, pid), what="another radio")
        for seconds in (600.0, 0.0):  # as `swarm hand cut` does
            cut_link(simulation.run_dir, "r0", "r2", seconds)
        pid = pid_of(simulation.run_dir, "radio", "radio")
        assert pid is not None
        os.kill(pid, signal.SIGSTOP)
        os.kill(pid, signal.SIGCONT)
        report = simulation.finish()
        assert report["problems"] == []
        assert report["restarts"] == 1
        assert is_undisturbed(simulation, *LINE)


def test_the_others_go_on_without_a_robot_that_is_switched_off_and_take_it_in_again() -> None:
    with Simulation(
        "consensus", "--robots", "3", "--radio", "slots", "--seconds", "600",
        *("--absent", "drop", "--drop-after", "3", "--off", "r2@2s,8s"), **FORKED,
    ) as simulation:  # fmt: skip

        def agree() -> bool:
            """Whether all have the same mean after r2 has begun anew, which is another one than before."""
            paths = [simulation.trajectory(f"r{i}") for i in range(3)]
            values = [path.value(path.last, "value") for path in paths if path.last >= 0]
            return bool(paths[2].returns) and max(values) - min(values) < 1e-9

        wait_until(agree, timeout=300.0, what="all agree after r2 has begun anew")
        simulation.process.send_signal(signal.SIGINT)
        report = simulation.finish()
        assert report["problems"] == []
        assert report["missing"] == []
        assert report["restarts"] == 1
        values = [result["value"] for result in report["result"].values()]
        assert max(values) - min(values) < 1e-9
