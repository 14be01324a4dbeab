"""Topology at run time between real mesh processes, and the command `swarm mesh topology`."""

import json
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from conftest import Processes, ask, stop, wait_until
from mesh_rig import Build, Swarm, build

from laptop.cli import main
from services.mesh.topology_file import NAME
from swarm.bus.zenoh_bus import Bus
from swarm.messages import Topology, TopologyRequest, read
from swarm.process.simulations import LOCK, claim

__all__ = ["build"]

LINE = (("r0", "r1"), ("r1", "r2"), ("r2", "r3"))
ALL = {("r0", "r1"), ("r1", "r2"), ("r2", "r3"), ("r0", "r3"), ("r0", "r2"), ("r1", "r3")}

Command = Callable[..., tuple[int, str]]


@pytest.fixture
def command(capsys: pytest.CaptureFixture[str]) -> Iterator[Command]:
    """`swarm mesh topology ...`; its exit code and what it printed."""

    def run(*arguments: str) -> tuple[int, str]:
        with pytest.raises(SystemExit) as ended:
            main(("mesh", "topology", *arguments))
        shown = capsys.readouterr()
        return int(ended.value.code or 0), shown.out + shown.err

    return run


def topology(swarm: Swarm, name: str) -> Topology:
    """As a robot's mesh tells it."""
    key = f"swarm/{name}/mesh/topology"
    return read(key, ask(swarm[name].bus, key))


def has(swarm: Swarm, name: str, version: int, *neighbours: str) -> bool:
    found = topology(swarm, name)
    return found.version >= version and found.up == neighbours and not found.kept


def test_a_topology_is_set_on_one_robot_and_seen_on_another(build: Build, command: Command) -> None:
    swarm = build(edges=LINE, model="latency=0.005")
    swarm.start()
    seen: list[Topology] = []
    swarm["r3"].bus.subscribe("swarm/r3/mesh/topology", lambda key, payload: seen.append(read(key, payload)))
    (swarm.runtime / LOCK).touch()
    with claim(swarm.runtime):
        place = ("--run-dir", str(swarm.runtime))
        code, text = command("show", *place)
        assert code == 0, text
        assert "version 0: r0-r1 r1-r2 r2-r3" in text
        code, text = command("set", "loop", *place, "--robots", "r0")
        assert code == 0, text
        wait_until(lambda: seen and seen[-1].version == 1 and seen[-1].up == ("r0", "r2"), what="r3 has it")
        assert (seen[-1].issuer, seen[-1].wanted) == ("r0", ("r0", "r2"))
        code, text = command("set", "r0-r3", "r1-r3", "r2-r3", *place, "--json", "--after", "1")
        assert code == 0, text
        told = json.loads(text)
        assert told["done"]
        assert {name: each["up"] for name, each in told["robots"].items()} == {
            "r0": ["r3"], "r1": ["r3"], "r2": ["r3"], "r3": ["r0", "r1", "r2"],
        }  # fmt: skip
        swarm.talk("r3", "r0")
        swarm.talk("r1", "r3")
        for wrong, reason in (
            (("set", "star"), "swarm: r0: expected line, loop, full, thesis-d or random:SEED, got 'star'"),
            (
                ("set", "r0-r1", "r2-r3"),
                "swarm: r0: not connected: these parts could not reach",
            ),
            (("set", "r0-r9"), "swarm: r0: link r0-r9: there is no robot 'r9'"),
            (("set", "line", "--after", "1"), "swarm: r0: version 2 is in force, not 1"),
            (("set", "r0-r1", "nonsense!"), "swarm: 'nonsense!' is no link: write r0-r1"),
        ):
            code, text = command(*wrong, *place, "--robots", "r0")
            assert code == 2
            assert text.startswith(reason), text
        # Whoever is silent is named, and the command says by its code that not all is well.
        mesh = swarm["r2"].mesh
        assert mesh is not None
        assert stop(mesh) == 0
        code, text = command("show", *place)
        assert code == 1
        assert "silent" in text


def test_a_kill_in_the_middle_and_a_restart_of_all_keep_the_newest_topology(build: Build, command: Command) -> None:
    swarm = build(edges=LINE, model="latency=0.02")
    swarm.start()
    (swarm.runtime / LOCK).touch()
    with claim(swarm.runtime):
        place = ("--run-dir", str(swarm.runtime), "--robots", "r0")
        command("set", "r0-r1", "r0-r2", "r0-r3", *place, "--timeout", "0")
        mesh = swarm["r3"].mesh
        assert mesh is not None
        mesh.kill()
        mesh.wait()
        wait_until(lambda: has(swarm, "r0", 1, "r1", "r2"), what="the others go on")
        swarm["r3"].start()
        wait_until(lambda: has(swarm, "r3", 1, "r0"), what="r3 has it, too")
        for robot in swarm.robots.values():
            assert robot.mesh is not None
            robot.mesh.kill()
            robot.mesh.wait()
        for robot in swarm.robots.values():
            robot.start()
        wait_until(lambda: has(swarm, "r0", 1, "r1", "r2", "r3"), what="all go on with it")
        # A damaged file counts for nothing; the neighbours know.
        robot = swarm["r3"]
        assert robot.mesh is not None
        assert stop(robot.mesh) == 0
        path = robot.disk / NAME
        data = bytearray(path.read_bytes())
        data[20] ^= 1
        path.write_bytes(data)
        robot.start()
        wait_until(lambda: has(swarm, "r3", 1, "r0"), what="r3 is told")
        # An answer may come in the moment before the file is on disk.
        wait_until(lambda: path.read_bytes() != bytes(data), what="the file is whole again")


def test_robots_find_their_neighbours_and_mend_the_swarm(build: Build) -> None:
    swarm = build(edges=tuple(sorted(ALL)), model="latency=0.005", auto=True)
    for robot in swarm.robots.values():
        robot.start()

    def await_whole(*names: str) -> None:
        def told() -> list[Topology]:
            return [topology(swarm, name) for name in names]

        def whole() -> bool:
            found = told()
            if len({each.edges for each in found}) > 1:
                return False
            return all(len(each.up) >= 2 and not each.kept for each in found)

        wait_until(whole, what=lambda: f"{names} have two neighbours each, and tell now: {told()}")

    await_whole("r0", "r1", "r2", "r3")
    mesh = swarm["r1"].mesh
    assert mesh is not None
    mesh.kill()
    mesh.wait()
    await_whole("r0", "r2", "r3")
    swarm["r1"].start()
    await_whole("r0", "r1", "r2", "r3")


DISK_HANGS = """
import threading
from services.mesh import __main__ as mesh, file_writer
from swarm.process import service

file_writer._END_S = 0.1
file_writer.save = lambda *_: threading.Event().wait()
service.run(mesh.main)
"""


@pytest.mark.usefixtures("router")
def test_a_mesh_whose_disk_hangs_goes_on_and_ends_when_it_is_told_to(processes: Processes, runtime: Path) -> None:
    """The thread that had the topology changed, here that of the bus, wrote the file and did nothing else meanwhile."""
    mesh = processes.start_ready("-c", DISK_HANGS)
    key = "swarm/r0/mesh/topology"
    with Bus.of(runtime) as bus:

        def is_set() -> bool:
            bus.publish("swarm/r0/mesh/set/topology", TopologyRequest("1", "", (("r0", "r1"),), None))
            return read(key, ask(bus, key)).version == 1

        wait_until(is_set, what="the answer of a mesh whose disk hangs")
        assert stop(mesh) == 0
