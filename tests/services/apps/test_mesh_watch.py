"""The watch of an app's process over its connection with the mesh."""

import socket
from pathlib import Path

import pytest

from services.apps.mesh_watch import LOOK_S, MOST_SILENT, SILENT, MeshWatch, is_listening
from sim.virtual.bus import VirtualBus, VirtualRouter
from sim.virtual.events import EventQueue
from sim.virtual.runtime import VirtualRuntime
from swarm.process.paths import ENDPOINT_PROTOCOL


class World:
    """A process of an app, its mesh, and when the bus was opened anew."""

    def __init__(self) -> None:
        self.queue = EventQueue()
        router = VirtualRouter(self.queue)
        self.mesh, bus = VirtualBus(router), VirtualBus(router)
        self.runs = True
        self.renewed: list[float] = []
        self.runtime = VirtualRuntime("r0", self.queue, bus)
        MeshWatch(self.runtime, lambda: self.runs, lambda: self.renewed.append(self.queue.now))

    def silence(self, seconds: float) -> None:
        self.queue.run(self.queue.now + seconds)

    def word(self) -> None:
        self.mesh.publish("swarm/r0/mesh/links", b"anything")
        self.queue.run(self.queue.now)


def test_a_mesh_that_is_heard_leaves_the_bus_alone() -> None:
    world = World()
    for _ in range(10):
        world.silence((SILENT - 1) * LOOK_S)
        world.word()
    assert not world.renewed


def test_a_mesh_that_runs_and_is_not_heard_has_the_bus_opened_anew_and_ever_more_rarely() -> None:
    world = World()
    world.silence((SILENT + 0.5) * LOOK_S)
    assert world.renewed == pytest.approx([SILENT * LOOK_S])
    world.silence(3600.0)
    pauses = [after - before for before, after in zip(world.renewed, world.renewed[1:], strict=False)]
    assert pauses == sorted(pauses)
    assert pauses[:3] == pytest.approx([2 * SILENT * LOOK_S, 4 * SILENT * LOOK_S, 8 * SILENT * LOOK_S])
    assert pauses[-1] == pytest.approx(MOST_SILENT * LOOK_S)
    assert world.runtime.counters["bus_renewed"] == len(world.renewed)


def test_a_word_of_the_mesh_makes_the_watch_as_quick_as_at_first() -> None:
    world = World()
    world.silence(1000.0)
    world.word()
    world.renewed.clear()
    world.silence((SILENT + 0.5) * LOOK_S)
    assert len(world.renewed) == 1


def test_a_mesh_that_does_not_run_is_waited_for() -> None:
    world = World()
    world.runs = False
    world.silence(1000.0)
    assert not world.renewed
    world.runs = True
    world.silence(SILENT * LOOK_S)
    assert len(world.renewed) == 1


def test_a_process_listens_at_a_socket_or_does_not(tmp_path: Path) -> None:
    endpoint = f"{ENDPOINT_PROTOCOL}/{tmp_path / 'bus.mesh.sock'}"
    assert not is_listening(endpoint)
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(str(tmp_path / "bus.mesh.sock"))
        assert not is_listening(endpoint)
        server.listen()
        assert is_listening(endpoint)
    assert not is_listening(endpoint)  # its file is still there
