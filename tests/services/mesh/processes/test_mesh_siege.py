"""Real meshes with a key under attack over real sockets, while two robots talk: nothing of that is lost."""

import contextlib
import itertools
import os
import socket
from pathlib import Path

import pytest
from conftest import wait_until
from mesh_rig import SYNC, Build, Swarm, build, hello

from services.mesh.core.wire import frames
from swarm.config.keyfile import new_key_file

__all__ = ["build"]

MESSAGES = 100

ATTACKS = (
    b"",
    b"\xff\xff\xff\xff" * 64,
    b"GET / HTTP/1.1\r\n\r\n",
    hello(),
    hello(insecure=False, key_ids=(1000,)),
    hello(insecure=False, key_ids=(1000,)) + frames.encode_confirm(bytes(32)),
    hello(insecure=False, key_ids=(1000,))[:20],
    os.urandom(200),
)
"""No key, wrong key, huge lengths, half a HELLO that never goes on, noise."""


def resident(pid: int) -> int:
    """Bytes of memory of a process."""
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def call(swarm: Swarm, data: bytes) -> socket.socket | None:
    """Connect to r1 and write; None where it is closed before that."""
    sock = socket.socket()
    sock.settimeout(5.0)
    try:
        sock.connect(("127.0.0.1", swarm.ports["r1"]))
        sock.sendall(data)
    except OSError:
        sock.close()
        return None
    return sock


@pytest.mark.parametrize("connections", [100, pytest.param(1000, marks=pytest.mark.slow)])
def test_hostile_callers_take_nothing_from_those_who_talk(build: Build, runtime: Path, connections: int) -> None:
    key = runtime / "key"
    new_key_file(key, 1000.0)
    swarm = build("tcp", (("r0", "r1"), ("r1", "r2")), key=key)
    swarm.start()
    swarm.talk("r0", "r1")
    swarm.talk("r1", "r2")
    for robot in swarm.robots.values():
        robot.samples.clear()
    mesh = swarm["r1"].mesh
    assert mesh is not None
    before = resident(mesh.pid)
    slow: list[socket.socket] = []
    with contextlib.ExitStack() as stack:
        for number, data in zip(range(connections), itertools.cycle(ATTACKS), strict=False):
            sock = call(swarm, data)
            if sock is not None:
                # Every tenth stays, and says a byte now and then; the others hang up at once.
                if number % 10 == 0:
                    slow.append(stack.enter_context(sock))
                else:
                    sock.close()
            for each in slow[-5:]:
                with contextlib.suppress(OSError):
                    each.send(b"\0")
            if number % (connections // MESSAGES) == 0:
                payload = (number * MESSAGES // connections).to_bytes(4, "big")
                swarm["r0"].bus.publish(SYNC.format("r0"), payload)
                swarm["r2"].bus.publish(SYNC.format("r2"), payload)
        expected = [number.to_bytes(4, "big") for number in range(MESSAGES)]

        def heard(sender: str) -> list[bytes]:
            # Numbers alone: `talk` repeats its greeting, and a late one may still come.
            return [data for each, data in swarm["r1"].samples if each == SYNC.format(sender) and len(data) == 4]

        wait_until(lambda: len(heard("r0")) == len(heard("r2")) == MESSAGES, what="all messages arrive")
    assert heard("r0") == heard("r2") == expected
    for peer in ("r0", "r2"):
        assert swarm["r1"].links[peer].connection == 1
    assert resident(mesh.pid) - before < 8 * 1024 * 1024

    def turned_away() -> int:
        counters = swarm["r1"].status().counters
        refused = sum(count for name, count in counters.items() if name.startswith("refused_"))
        return refused + sum(counters.get(name, 0) for name in ("half_open", "bad_frames", "silent", "transport_lost"))

    # Those who came last have only just hung up.
    wait_until(lambda: turned_away() >= connections * 0.9, what="the callers are turned away")
    swarm.talk("r1", "r0")
