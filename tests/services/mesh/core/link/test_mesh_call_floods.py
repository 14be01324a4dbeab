"""Floods of calls under virtual time: robots still meet, and what is remembered of strangers is bounded."""

import random
from collections.abc import Callable

import pytest
from attacked_links import (
    HANDSHAKE_TIMEOUT,
    RECOVERY,
    SYNC,
    Watched,
    bit_flipped,
    byte_missing,
    class_changed,
    endless_length,
    forged_bye,
    hello,
    last_frame_again,
    watched,
)
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule, run_state_machine_as_test
from mesh_world import End, Raw

from services.mesh.core import calling
from services.mesh.core.calling import MAX_HALF_OPEN, MAX_PER_SOURCE, Callers
from services.mesh.core.link.calls import Caller

__all__ = ["watched"]


def test_a_slow_hello_has_the_time_of_a_handshake(watched: Watched) -> None:
    caller = watched.world.connect_raw("r1")
    for byte in hello():
        if caller.open:
            caller.write(bytes((byte,)))
        watched.run(1.2 * HANDSHAKE_TIMEOUT / len(hello()))
    assert not caller.open
    assert watched.world.bots["r1"].counters["silent"] == 1


def flood(watched: Watched, sources: int, count: int = 1000) -> list[Raw]:
    return [
        watched.world.connect_raw("r1", caller=Caller(f"10.0.0.{number % sources}" if sources else ""))
        for number in range(count)
    ]


@pytest.mark.parametrize(("sources", "open_at_once"), [(0, MAX_HALF_OPEN), (1, MAX_PER_SOURCE), (256, MAX_HALF_OPEN)])
def test_a_thousand_callers_are_closed_at_once(watched: Watched, sources: int, open_at_once: int) -> None:
    raws = flood(watched, sources)
    assert sum(raw.open for raw in raws) == open_at_once
    assert watched.world.bots["r1"].counters["half_open"] == 1000 - open_at_once
    watched.run(HANDSHAKE_TIMEOUT + 0.1)
    assert not any(raw.open for raw in raws)
    assert len(watched.warnings()) <= 2


@pytest.mark.parametrize("caller", [Caller("10.0.1.1", reserved=True), Caller("B8:27:EB:00:00:01", robot="r0")])
def test_a_flood_does_not_lock_out_a_neighbour(watched: Watched, caller: Caller) -> None:
    world = watched.world
    world.callers["r0"] = caller
    world.kill("r0")
    watched.run(0.2)
    for _ in range(10):
        flood(watched, 256, 100)
        watched.run(0.1)
    world.start("r0")
    for _ in range(3):
        flood(watched, 256, 100)
        watched.run(0.1)
    assert world.link("r1", "r0").state == "up"
    assert world.link("r1", "r0").connection == 2


def test_a_refused_stranger_is_shut_out_for_a_while(watched: Watched) -> None:
    stranger = Caller("10.0.0.1")
    tries = 0
    for _ in range(100):
        watched.world.connect_raw("r1", b"GET / HTTP/1.1\r\n", caller=stranger)
        watched.run(0.1)
        tries = watched.world.bots["r1"].counters["bad_frames"]
    assert 4 <= tries <= 8
    assert watched.world.bots["r1"].counters["half_open"] == 100 - tries


def test_an_address_of_no_robot_is_closed_at_once(watched: Watched) -> None:
    raw = watched.world.connect_raw("r1", hello(), caller=Caller("00:00:00:00:00:99", robot=""))
    assert not raw.open
    assert watched.world.bots["r1"].counters["refused_robot"] == 1
    assert "00:00:00:00:00:99 is the address of no robot" in watched.warnings()[0]


def test_a_member_at_anothers_address_is_refused(watched: Watched) -> None:
    """r0 holds the key, but calls from r2's address."""
    watched.world.callers["r0"] = Caller("B8:27:EB:00:00:02", robot="r2")
    watched.world.kill("r0")
    watched.world.start("r0")
    watched.run(3.0)
    assert watched.world.link("r1", "r0").connection == 1
    assert watched.world.bots["r1"].counters["refused_robot"] >= 2
    assert watched.warnings() == ["connection refused peer=r2 address=B8:27:EB:00:00:02 "
                                  "reason=robot r0 calls from the address of r2"]  # fmt: skip


def test_strangers_cannot_fill_the_log(watched: Watched) -> None:
    for number in range(1000):
        watched.world.connect_raw("r1", b"\xff\xff", caller=Caller(f"2001:db8::{number:x}"))
        watched.world.run(0.001)
    watched.world.run(3.0)
    assert len(watched.warnings()) <= 3


def test_what_is_remembered_of_strangers_is_bounded() -> None:
    gate = Callers()
    for number in range(1000):
        gate.refused(Caller(f"10.0.{number >> 8}.{number & 255}"), 0.0)
    assert len(gate._refused) == calling._MAX_REMEMBERED
    last = Caller("10.0.3.231")
    assert not gate.has_room(last, (), 0.1)
    assert gate.has_room(last, (), 0.3)
    gate.refused(last, 0.3)
    gate.confirmed(last)
    assert gate.has_room(last, (), 0.31)
    for _ in range(50):
        gate.refused(last, 1.0)
    assert gate.has_room(last, (), 1.0 + calling.LONGEST_SHUT_OUT)


class Siege(RuleBasedStateMachine):
    """Somebody records all that r0 and r1 say, changes it at will and calls r1 as often as it likes."""

    @initialize(seed=st.integers(0, 2**16))
    def begin(self, seed: int) -> None:
        self.random = random.Random(seed)
        self.watched = Watched()
        self.world = self.watched.world
        self.watched.changes = self._change
        self.change: Callable[[End, bytes], bytes] | None = None
        self.raws: list[Raw] = []
        self.number = 0

    def _change(self, end: End, data: bytes) -> bytes:
        if self.change is None:
            return data
        change, self.change = self.change, None
        return change(end, data)

    @rule(sender=st.sampled_from(("r0", "r1")))
    def publish(self, sender: str) -> None:
        self.number += 1
        if sender == "r0":
            self.world.publish(sender, SYNC.format(sender), self.number.to_bytes(4, "big"))
        self.watched.run(0.05)

    @rule(seconds=st.floats(0.01, 3.0))
    def wait(self, seconds: float) -> None:
        self.watched.run(seconds)

    @rule()
    def restart(self) -> None:
        self.world.kill("r0")
        self.world.start("r0")

    @rule(robot=st.sampled_from(("r0", "r1")), start=st.integers(0, 30), count=st.integers(1, 30))
    def replay(self, robot: str, start: int, count: int) -> None:
        writes = self.watched.recorded(robot)[start : start + count]
        self.raws.append(self.world.connect_raw("r1", *writes))

    @rule(noise=st.binary(max_size=300), with_hello=st.booleans())
    def call(self, noise: bytes, with_hello: bool) -> None:
        self.raws.append(self.world.connect_raw("r1", hello() if with_hello else b"", noise))

    @rule(robot=st.sampled_from(("r0", "r1")), start=st.integers(0, 200), data=st.binary(min_size=1, max_size=40))
    def add(self, robot: str, start: int, data: bytes) -> None:
        """Put bytes into a connection that is there: a stranger's, made up or recorded."""
        if self.raws and self.raws[-1].open:
            record = b"".join(self.watched.recorded(robot))[start : start + 100]
            self.raws[-1].write(data if self.random.random() < 0.5 else record)

    @rule(
        what=st.sampled_from((last_frame_again, bit_flipped, class_changed, byte_missing, forged_bye, endless_length))
    )
    def tamper(self, what: Callable[[End, bytes], bytes]) -> None:
        self.change = lambda end, data: what(end, data) if len(data) > 10 else data

    @rule(robot=st.sampled_from(("r0", "r1")), index=st.integers(0, 60))
    def exchange(self, robot: str, index: int) -> None:
        writes = self.watched.recorded(robot)
        self.change = lambda end, data: writes[index % len(writes)]

    @invariant()
    def nothing_is_forged(self) -> None:
        heard = [payload for key, payload in self.world.bots["r1"].inbox if key == SYNC.format("r0")]
        assert heard == sorted(set(heard)), "in order, each at most once"
        assert all(int.from_bytes(payload, "big") <= self.number for payload in heard)
        assert {key for key, _ in self.world.bots["r1"].inbox} <= {SYNC.format("r0"), SYNC.format("r2")}
        assert {key for key, _ in self.world.bots["r0"].inbox} <= {SYNC.format("r1")}
        for raw in self.raws:
            peer = raw.end.peer
            assert peer is None or peer.session is None or not peer.session.is_up

    def teardown(self) -> None:
        if not hasattr(self, "watched"):
            return
        self.watched.changes = None
        self.watched.run(RECOVERY)
        assert self.world.all_up()
        self.watched.check_others()


def test_a_mesh_withstands_random_strangers() -> None:
    run_state_machine_as_test(Siege, settings=settings(max_examples=6, stateful_step_count=25, deadline=None))


@pytest.mark.slow
def test_a_mesh_withstands_many_random_strangers() -> None:
    run_state_machine_as_test(Siege, settings=settings(max_examples=100, stateful_step_count=50, deadline=None))
