"""RFCOMM sockets of two robots on the stand-in for the kernel's, and bytes to and from them."""

import random
import select
from collections.abc import Iterator
from pathlib import Path

import pytest
from conftest import wait_until
from rfcomm_air import RfcommAir

from services.mesh.core.link.calls import Local, dials
from services.mesh.links import rfcomm
from services.mesh.links.pipe import Pipe
from services.mesh.links.rfcomm import Radio
from swarm import clock
from swarm.config import parse

A, B, C = (f"B8:27:EB:00:00:0{digit}" for digit in "ABC")
STRANGER = "00:11:22:33:44:55"


@pytest.fixture
def air() -> Iterator[RfcommAir]:
    made = RfcommAir(A, B)
    yield made
    for sock in made.sockets:
        sock.close()


@pytest.fixture
def listener(air: RfcommAir) -> Iterator[rfcomm.RfcommListener]:
    made = rfcomm.RfcommListener(Radio(B), {A.lower(): "r0"}, open_socket=air.open)
    yield made
    made.close()


def dial(air: RfcommAir, adapter: str = A, **radio: object) -> Pipe:
    return rfcomm.dial(Radio(adapter, **radio), B, open_socket=air.open)  # type: ignore[arg-type]


def accept(listener: rfcomm.RfcommListener) -> Pipe:
    wait_until(lambda: select.select([listener], [], [], 0)[0])
    return listener.accept()


def read(pipe: Pipe) -> bytes:
    """What the mesh's thread would get next, without waiting longer than a test may."""
    found: list[bytes] = []

    def look() -> bool:
        now = clock.now()
        if pipe.wants_read(now) and select.select([pipe], [], [], 0)[0]:
            pipe.read(now)
        if (data := pipe.take(now)) is not None:
            found.append(data)
        return bool(found)

    wait_until(look)
    return found[0]


def write(pipe: Pipe, data: bytes) -> None:
    pipe.offer(data)
    assert pipe.flush()


CONFIG = f"""\
network = "lab"
[[robots]]
name = "r0"
bluetooth = "{A}"
[[robots]]
name = "r1"
bluetooth = "{B}"
[topology]
shape = "line"
[mesh]
insecure = true
"""


def local(me: str, text: str = CONFIG, *, pages: bool = False) -> Local:
    config = parse(text, Path("swarm.toml"))
    return Local(
        me,
        "lab",
        random.getrandbits(64),
        insecure=True,
        dials={peer: dials(config.robot(me), config.robot(peer)) for peer in config.neighbours(me)},
        robots=frozenset(config.names),
        pages=pages,
    )
