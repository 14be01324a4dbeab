"""Controllers of the lab's radio in virtual time, each with a host that a test plays."""

from random import Random

import pytest

from lab.radio.core import hci
from lab.radio.core.air import Air
from lab.radio.core.hci import Ev, Op

A, B, C = "02:10:BA:00:00:01", "02:10:BA:00:00:02", "02:10:BA:00:00:03"
KEY = bytes(range(16))


def command(op: int, parameters: bytes = b"") -> bytes:
    return bytes((1, op & 0xFF, op >> 8, len(parameters))) + parameters


class World:
    """Three hosts at their controllers, and a clock."""

    def __init__(self) -> None:
        self.air = Air(Random(1), lambda: KEY)
        self.now = 0.0
        self.heard: dict[str, list[bytes]] = {}
        for address in (A, B, C):
            self.heard[address] = []
            self.air.add(address)
            self.tell(address, Op.WRITE_SCAN, b"\3")
            self.heard[address].clear()

    def tell(self, address: str, op: int, parameters: bytes = b"") -> None:
        self.air.receive(address, command(op, parameters), self.now)
        self.collect()

    def collect(self) -> None:
        for address, packet in self.air.to_send():
            self.heard[address].append(packet)

    def run(self, seconds: float) -> None:
        end = self.now + seconds
        while (deadline := self.air.next_deadline()) <= end:
            self.now = max(self.now, deadline)
            self.air.handle_timer(self.now)
            self.collect()
        self.now = end
        self.air.handle_timer(end)

    def events(self, address: str) -> list[tuple[int, bytes]]:
        """(code, body) of what came since the last time."""
        packets, self.heard[address] = self.heard[address], []
        return [(packet[1], packet[3:]) for packet in packets if packet[0] == 4]

    def codes(self, address: str) -> list[int]:
        return [code for code, _ in self.events(address)]

    def link(self, caller: str, called: str) -> tuple[int, int]:
        """Make a link; the handles of both sides."""
        self.tell(caller, Op.CREATE_CONNECTION, hci.to_wire(called) + bytes(7))
        self.run(3.0)
        assert self.codes(called)[-1] == Ev.CONNECTION_REQUEST
        self.tell(called, Op.ACCEPT_CONNECTION, hci.to_wire(caller) + b"\1")
        bodies = [dict(self.events(each))[Ev.CONNECTION_COMPLETE] for each in (caller, called)]
        assert all(body[0] == 0 for body in bodies)
        one, other = (int.from_bytes(body[1:3], "little") for body in bodies)
        return one, other

    def data(self, address: str, handle: int, payload: bytes) -> None:
        self.air.receive(address, b"\2" + hci.acl(handle, 0, payload)[1:], self.now)
        self.collect()

    def arrived(self, address: str) -> list[bytes]:
        packets = [packet[5:] for packet in self.heard[address] if packet[0] == 2]
        self.heard[address] = [packet for packet in self.heard[address] if packet[0] != 2]
        return packets


@pytest.fixture
def world() -> World:
    return World()


def result(world: World, address: str, op: int, handle: int) -> bytes:
    """What a command about a link gives, from its status on."""
    world.events(address)
    world.tell(address, op, handle.to_bytes(2, "little"))
    ((_, body),) = world.events(address)
    return body[3:]
