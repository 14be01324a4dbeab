"""Meshes over RFCOMM links that a stand-in socket family carries: they meet, part, knock and nudge."""

import logging
import os
import random
import socket
from collections import Counter
from pathlib import Path
from typing import cast

import pytest
from conftest import wait_until
from rfcomm_air import RfcommAir
from rfcomm_rig import CONFIG, STRANGER, A, B, C, accept, air, dial, listener, local, read, write

from services.mesh.core import calling
from services.mesh.core.link import calls
from services.mesh.core.routing.topology import Ground
from services.mesh.core.routing.wanted_links import InitialLinks
from services.mesh.core.wire import frames
from services.mesh.core.wire.frames import Hello
from services.mesh.links import rfcomm
from services.mesh.mesh import Chance
from services.mesh.mesh import Mesh as Shell
from services.mesh.network import Network
from services.mesh.sockets import Sockets
from swarm.bus.protocol import BusLike
from swarm.config import parse
from swarm.process.locked_runtime import LockedRuntime

__all__ = ["air", "listener"]

THREE = CONFIG.replace("[topology]", f'[[robots]]\nname = "r2"\nbluetooth = "{C}"\n[topology]')


class Mesh:
    """A whole mesh of one robot over the stand-in."""

    def __init__(self, name: str, air: RfcommAir, directory: Path, text: str = CONFIG, *, pages: bool = False) -> None:
        config, own = parse(text, Path("swarm.toml")), local(name, text, pages=pages)
        self.limits: list[tuple[str, str, float]] = []
        """Own and other address, time-out of the mesh: whose silence was to be limited."""
        self.network = Network(
            config, own, directory, open_bluetooth=air.open, supervise=lambda *each: self.limits.append(each)
        )
        self.counters: Counter[str] = Counter()
        self.inbox: list[tuple[str, bytes]] = []
        runtime = LockedRuntime(cast("BusLike", self), self.counters, logging.getLogger("mesh"))
        self.sockets = Sockets(runtime, self.network.listeners, self.network.dial)
        self.mesh = Shell(
            config,
            own,
            InitialLinks(Ground(config.names, config.edges, auto=False), own.dials),
            Chance(random.random, lambda: os.urandom(16)),
            own.incarnation,
            runtime,
            self.sockets,
            keep=lambda data: None,
            keep_stops=lambda data: None,
        )
        self.links = runtime.entry(self.mesh.links)
        self.relay = runtime.entry(self.mesh.publish)
        self.sockets.start(self.mesh)

    def wanted(self, key: str) -> bool:
        return False

    def publish(self, key: str, payload: bytes, *, urgent: bool) -> None:
        self.inbox.append((key, payload))

    @property
    def state(self) -> tuple[str, int, str]:
        (link,) = self.links().links
        return link.state, link.connection, link.reason

    def stop(self) -> None:
        self.sockets.stop()
        self.network.close()


def test_meshes_meet_over_rfcomm_part_and_meet_again(air: RfcommAir, runtime: Path) -> None:
    air.page_timeout = 0.05
    air.out_of_range.add(B)
    near, far = Mesh("r0", air, runtime), Mesh("r1", air, runtime)
    wait_until(lambda: near.state[2].startswith("host is down"))
    air.out_of_range.clear()
    wait_until(lambda: near.state[0] == far.state[0] == "up")
    key = "swarm/r0/app/x/sync/a"
    near.relay(0, key, b"hello")
    wait_until(lambda: (key, b"hello") in far.inbox)
    # The far robot loses its sockets as kill -9 would have it.
    for sock in [sock for sock in air.sockets if sock.fileno() >= 0 and sock.adapter == ""]:
        sock.shutdown(socket.SHUT_RDWR)
    wait_until(lambda: near.state[:2] == far.state[:2] == ("up", 2))
    assert near.counters["transport_lost"] == 1
    # For each link, by who has dialled.
    wait_until(lambda: near.limits == [(A, B, 3.0)] * 2)
    assert far.limits == []
    near.stop()
    far.stop()


def test_a_robot_that_is_back_knocks_at_one_that_only_calls(
    air: RfcommAir, runtime: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without the knock r0 would call again in hours."""
    monkeypatch.setattr(calls, "SHARE", 1e-7)
    monkeypatch.setattr(calls, "EAGER_S", 0.0)
    monkeypatch.setattr(calling, "KNOCK", 0.05)
    air.page_timeout = 0.05
    air.out_of_range.add(B)
    near = Mesh("r0", air, runtime, pages=True)
    wait_until(lambda: near.state[2].startswith("host is down"))
    air.out_of_range.clear()
    far = Mesh("r1", air, runtime, pages=True)
    wait_until(lambda: near.state[0] == far.state[0] == "up")
    wait_until(lambda: len(near.limits) == 1)
    assert far.limits == []  # r0 has called: the roles are those wanted
    asks = {sock.adapter: sock.link_mode for sock in air.sockets if sock.fileno() >= 0 and sock.channel}
    assert asks == {A: rfcomm.RFCOMM_LM_MASTER, B: 0}  # a knock at r0, which calls all, makes r0 the central
    near.network.follow({"r1": False})  # another robot is the hub now
    far.network.follow({"r0": True})
    asks = {sock.adapter: sock.link_mode for sock in air.sockets if sock.fileno() >= 0 and sock.channel}
    assert asks == {A: 0, B: rfcomm.RFCOMM_LM_MASTER}
    near.stop()
    far.stop()


class L2capSocket:
    """A raw socket that notes what is done with it."""

    def __init__(self, done: list[object]) -> None:
        self._done = done

    def setblocking(self, blocking: bool) -> None:
        assert not blocking

    def bind(self, address: object) -> None:
        self._done.append(address)

    connect = send = bind

    def close(self) -> None:
        self._done.append("closed")


def test_a_nudge_is_an_echo_request_from_the_own_adapter_to_the_other_end(
    air: RfcommAir, listener: rfcomm.RfcommListener, monkeypatch: pytest.MonkeyPatch
) -> None:
    done: list[object] = []
    near, far = dial(air), accept(listener)
    monkeypatch.setattr(rfcomm, "open_l2cap_socket", lambda: L2capSocket(done))
    near.nudge()
    far.nudge()
    echo = bytes.fromhex("08c80000")
    assert done == [(A, 0), (B, 0), echo, "closed", (B, 0), (A, 0), echo, "closed"]


def test_a_nudge_without_the_right_to_a_raw_socket_does_no_harm(
    air: RfcommAir, listener: rfcomm.RfcommListener, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refused() -> None:
        raise PermissionError

    monkeypatch.setattr(rfcomm, "open_l2cap_socket", refused)
    dial(air).nudge()


def test_the_other_links_are_nudged_when_one_has_ended(
    air: RfcommAir, runtime: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    nudged: list[str] = []
    monkeypatch.setattr(rfcomm.RfcommPipe, "nudge", lambda pipe: nudged.append(pipe._peer))
    air.adapters.add(C)
    meshes = {name: Mesh(name, air, runtime, THREE) for name in ("r0", "r1", "r2")}  # a line
    middle = meshes["r1"]
    wait_until(lambda: [each.state for each in middle.links().links] == ["up", "up"])
    assert nudged == []
    for sock in [sock for sock in air.sockets if sock.fileno() >= 0 and sock.adapter == A and not sock.channel]:
        sock.shutdown(socket.SHUT_RDWR)
    wait_until(lambda: nudged == [C])
    for mesh in meshes.values():
        mesh.stop()


def test_a_call_from_the_address_of_no_robot_is_ended_before_a_handshake(air: RfcommAir, runtime: Path) -> None:
    far = Mesh("r1", air, runtime)
    air.adapters.add(STRANGER)
    pipe = dial(air, STRANGER)
    write(pipe, frames.encode_hello(Hello("lab", "r0", 1, bytes(16), dialler=True, insecure=True)))
    assert not read(pipe)
    assert far.counters["refused_robot"] == 1
    far.stop()
