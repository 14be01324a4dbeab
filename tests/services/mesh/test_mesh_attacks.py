"""Attacks on authenticated links under virtual time: each is refused and counted, and no other link notices."""

import random
from collections.abc import Callable, Iterator

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule, run_state_machine_as_test
from mesh_world import End, Raw, World

from services.mesh.core.link import calls
from services.mesh.core.link.calls import LONGEST_DELAY, MAX_HALF_OPEN, MAX_PER_SOURCE, Caller, Callers
from services.mesh.core.wire import frames
from services.mesh.core.wire.frames import Hello
from swarm.config.types import MeshConfig

KEY_ID, SECRET = 7, bytes(range(32))
KEYS = {KEY_ID: SECRET}
OTHER = {KEY_ID: bytes(32)}
"""Another key under the same id."""

LINE = [("r0", "r1"), ("r1", "r2")]
SYNC = "swarm/{}/app/consensus/sync/00000000000000a1-0-3-9f3c21aa"
HANDSHAKE_TIMEOUT = MeshConfig().handshake
RECOVERY = 3.0 + 1.5 * LONGEST_DELAY + HANDSHAKE_TIMEOUT + 1.0


def hello(**changes: object) -> bytes:
    """What r0, which dials r1, might say."""
    values: dict[str, object] = {
        "network": "lab",
        "robot": "r0",
        "incarnation": 0,  # it tells no process, so it is no second robot
        "nonce": bytes(16),
        "dialler": True,
        "insecure": False,
        "key_ids": (KEY_ID,),
    }
    return frames.encode_hello(Hello(**(values | changes)))  # type: ignore[arg-type]


class Watched:
    """r0 - r1 - r2, where r1 and r2 talk all the time: none of it may be lost, nor their link be made anew."""

    def __init__(self, keys: dict[int, bytes] | None = KEYS) -> None:
        self.world = World(LINE, keys=keys)
        self.streams: dict[str, list[tuple[End, bytes]]] = {"r0": [], "r1": []}
        self.changes: Callable[[End, bytes], bytes] | None = None
        self.world.tap = self._tap
        self.world.run(1.0)
        assert self.world.all_up()
        self._count = 0

    def _tap(self, end: End, data: bytes) -> bytes:
        if end.peer is None or {end.robot, end.peer.robot} != {"r0", "r1"}:
            return data
        self.streams[end.robot].append((end, data))
        return data if self.changes is None else self.changes(end, data)

    def run(self, seconds: float) -> None:
        """Let time pass while r1 and r2 talk."""
        steps = max(1, round(seconds / 0.1))
        for _ in range(steps):
            for sender in ("r1", "r2"):
                self.world.publish(sender, SYNC.format(sender), self._count.to_bytes(4, "big"))
            self._count += 1
            self.world.run(seconds / steps)

    def recorded(self, robot: str) -> list[bytes]:
        """What a robot has sent over the link of r0 and r1 since the start, write by write."""
        return [data for _, data in self.streams[robot]]

    def check_others(self) -> None:
        """The link of r1 and r2 has lost nothing."""
        self.world.run(0.1)
        for sender, receiver in (("r1", "r2"), ("r2", "r1")):
            heard = [payload for key, payload in self.world.bots[receiver].inbox if key == SYNC.format(sender)]
            assert heard == [count.to_bytes(4, "big") for count in range(self._count)]
            assert self.world.link(receiver, sender).connection == 1
            assert self.world.link(receiver, sender).state == "up"

    def warnings(self, robot: str = "r1") -> list[str]:
        return [note.text for note in self.world.bots[robot].notes if note.problem]


@pytest.fixture
def watched() -> Iterator[Watched]:
    found = Watched()
    yield found
    found.check_others()


# -- callers without the key ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("written", "counter", "reason"),
    [
        (hello(insecure=True, key_ids=()), "refused_security", "it is insecure and we are not"),
        (hello(key_ids=()), "refused_key", "robot r0 has another key: none, ours is 00000007"),
        (hello(key_ids=(8, 9)), "refused_key", "robot r0 has another key: 00000009 00000008, ours is 00000007"),
        (hello() + frames.encode_confirm(bytes(32)), "refused_key", "who calls itself r0 does not hold the key"),
        (hello() + frames.encode_confirm(), "bad_frames", "CONFIRM of 0 bytes: it has 32 here"),
        (hello() + frames.encode_data(1, 0, b"x"), "bad_frames", "frame kind 6 before CONFIRM"),
        (hello(robot="r9"), "refused_robot", "robot r9 is not in our configuration"),
        (hello(network="other"), "refused_network", "network 'other'"),
        (hello(versions=(4, 5)), "refused_version", "speaks protocol versions 4 to 5"),
        (b"\xff\xff" + bytes(100), "bad_frames", "frame length 65535: 1 to 256"),
        (hello() + b"\xff\xff" + bytes(100), "bad_frames", "frame length 65535: 1 to 256"),
        (hello(), "silent", "no handshake within 8 s"),
    ],
)
def test_without_the_key_nobody_gets_in(watched: Watched, written: bytes, counter: str, reason: str) -> None:
    for _ in range(3):
        caller = watched.world.connect_raw("r1", written)
        watched.run(HANDSHAKE_TIMEOUT + 0.2)
        assert not caller.open
    assert watched.world.bots["r1"].counters[counter] == 3
    assert len(watched.warnings()) == 1
    assert reason in watched.warnings()[0]
    assert watched.world.link("r1", "r0").connection == 1
    assert watched.world.link("r1", "r0").state == "up"


def test_a_robot_with_another_key_is_refused_by_both_ends_and_backs_off(watched: Watched) -> None:
    world = watched.world
    world.kill("r0")
    world.overrides["r0"] = {"keys": OTHER}
    world.dials.clear()
    world.start("r0")
    watched.run(60.0)
    assert world.link("r0", "r1").connection == 0
    # Whose CONFIRM comes first finds out; the other end reads its BYE.
    refused = [world.bots[name].counters["refused_key"] for name in ("r0", "r1")]
    assert sum(refused) >= 12
    assert max(refused) <= len(world.dials) <= 30
    assert len(watched.warnings()) <= 1
    assert "another key" in world.link("r0", "r1").reason or "does not hold the key" in world.link("r0", "r1").reason
    world.kill("r0")
    world.overrides.clear()
    world.start("r0")
    watched.run(RECOVERY)
    assert world.all_up()


@pytest.mark.parametrize("insecure", ["r0", "r1"])
def test_secure_and_insecure_robots_never_mix(insecure: str) -> None:
    world = World([("r0", "r1")], keys=KEYS)
    world.kill(insecure)
    world.overrides[insecure] = {"insecure": True, "keys": {}}
    world.start(insecure)
    world.run(10.0)
    assert all(world.link(name, peer).connection == 0 for name, peer in (("r0", "r1"), ("r1", "r0")))
    assert sum(bot.counters["refused_security"] for bot in world.bots.values()) >= 2


def test_a_robot_without_any_key_is_refused(watched: Watched) -> None:
    watched.world.kill("r0")
    watched.world.overrides["r0"] = {"keys": {}}
    watched.world.start("r0")
    watched.run(5.0)
    assert watched.world.link("r0", "r1").connection == 0
    assert watched.world.bots["r1"].counters["refused_key"] >= 2


# -- rotation ------------------------------------------------------------------------------------------------


def test_keys_are_replaced_one_robot_at_a_time_without_losing_a_link() -> None:
    world = World(LINE, keys={1: SECRET})
    world.run(1.0)
    for keys in ({2: bytes(32), 1: SECRET}, {2: bytes(32)}):
        for robot in ("r1", "r0", "r2"):
            world.kill(robot)
            world.overrides[robot] = {"keys": keys}
            world.start(robot)
            world.run(RECOVERY)
            assert world.all_up()
    assert sum(bot.counters["refused_key"] for bot in world.bots.values()) == 0
    world.kill("r0")
    world.overrides["r0"] = {"keys": {1: SECRET}}
    world.start("r0")
    world.run(RECOVERY)
    assert world.link("r0", "r1").connection == 0


def test_nobody_between_can_make_two_robots_use_the_older_key() -> None:
    old, new = {1: SECRET}, {2: bytes(32)}
    world = World([("r0", "r1")], keys=new | old)
    of_r0 = world.bots["r0"].node

    def without_the_new(end: End, data: bytes) -> bytes:
        return data.replace(b"\x02\0\0\0\x01\0\0\0\x03lab", b"\x01\0\0\0\x01\0\0\0\x03lab")

    world.tap = without_the_new
    world.run(20.0)
    assert world.bots["r0"].node is of_r0
    assert world.link("r0", "r1").connection == 0
    assert world.bots["r0"].counters["refused_key"] + world.bots["r1"].counters["refused_key"] >= 4
    world.tap = None
    world.run(RECOVERY)
    assert world.all_up()


# -- replay, reflection, changes -----------------------------------------------------------------------------


@pytest.mark.parametrize("writes", [1, 2, 100])
def test_a_recorded_dialler_is_refused(watched: Watched, writes: int) -> None:
    """Its HELLO alone, with its CONFIRM, and all that it ever sent."""
    watched.run(2.0)
    for _ in range(3):
        caller = watched.world.connect_raw("r1", *watched.recorded("r0")[:writes])
        watched.run(HANDSHAKE_TIMEOUT + 0.2)
        assert not caller.open
    counters = watched.world.bots["r1"].counters
    assert counters["silent" if writes == 1 else "refused_key"] == 3
    assert watched.world.link("r1", "r0").connection == 1


def test_a_recorded_listener_is_refused(watched: Watched) -> None:
    """Who answers r0's calls in r1's place with what r1 once said, holds no key."""
    watched.run(1.0)
    record = b"".join(watched.recorded("r1"))
    watched.world.break_connections("r1")  # r2's link, too: it is met again below
    watched.changes = lambda end, data: record if end.robot == "r1" else data
    watched.world.run(10.0)
    assert watched.world.bots["r0"].counters["refused_key"] >= 2
    assert watched.world.link("r0", "r1").connection == 1
    watched.changes = None
    watched.world.run(RECOVERY)
    assert watched.world.all_up()
    watched.check_others = lambda: None  # type: ignore[method-assign]


def test_a_mirror_is_refused(watched: Watched) -> None:
    caller = watched.world.connect_raw("r1")
    watched.run(0.1)
    caller.write(caller.heard)
    watched.run(0.2)
    assert not caller.open
    assert watched.world.bots["r1"].counters["refused_robot"] == 1
    assert "our own name" in watched.warnings()[0]


def test_a_mirrored_confirm_is_refused(watched: Watched) -> None:
    caller = watched.world.connect_raw("r1", hello())
    watched.run(0.1)
    confirm = caller.heard[-35:]
    assert confirm[:3] == b"\x21\0\x02"
    caller.write(confirm)
    watched.run(0.2)
    assert not caller.open
    assert watched.world.bots["r1"].counters["refused_key"] == 1


def last_frame_again(end: End, data: bytes) -> bytes:
    return data + data


def bit_flipped(end: End, data: bytes) -> bytes:
    return data[:-9] + bytes((data[-9] ^ 1,)) + data[-8:]


def tag_flipped(end: End, data: bytes) -> bytes:
    return data[:-1] + bytes((data[-1] ^ 0x80,))


def class_changed(end: End, data: bytes) -> bytes:
    return data[:2] + bytes((data[2] ^ 0x10,)) + data[3:]


def byte_missing(end: End, data: bytes) -> bytes:
    return data[:5] + data[6:]


def truncated(end: End, data: bytes) -> bytes:
    return data[:-3]


def endless_length(end: End, data: bytes) -> bytes:
    return b"\xff\xff" + data[2:]


def without_tag(end: End, data: bytes) -> bytes:
    return frames.encode_heartbeat(frames.Heartbeat(0, 0, 1))


def forged_bye(end: End, data: bytes) -> bytes:
    return frames.encode_bye(frames.CLOSING) + data


@pytest.mark.parametrize(
    ("change", "counter"),
    [
        (last_frame_again, "bad_tags"),
        (bit_flipped, "bad_tags"),
        (tag_flipped, "bad_tags"),
        (class_changed, "bad_tags"),
        (byte_missing, "bad_tags"),
        (truncated, "bad_tags"),
        (endless_length, "bad_frames"),
        (without_tag, "bad_tags"),
        (forged_bye, "bad_tags"),
    ],
)
def test_a_changed_frame_ends_its_connection_only(
    watched: Watched, change: Callable[[End, bytes], bytes], counter: str
) -> None:
    for _ in range(3):
        done: list[bytes] = []

        def once(end: End, data: bytes, done: list[bytes] = done) -> bytes:
            if end.robot != "r0" or done or watched.world.link("r0", "r1").state != "up":
                return data
            done.append(data)
            return change(end, data)

        watched.changes = once
        watched.run(5.0)
        assert done
    bot = watched.world.bots["r1"]
    assert bot.counters[counter] == 3
    assert sum("connection ended peer=r0" in text for text in watched.warnings()) == 1
    assert bot.counters["byes"] == 0
    assert watched.world.link("r1", "r0").connection == 4
    assert watched.world.all_up()
    assert not [each for each in bot.inbox if each[0] == SYNC.format("r0")]


def test_reflected_frames_end_the_connection(watched: Watched) -> None:
    """A frame of r1 comes back to r1 in place of r0's next one."""
    own = watched.recorded("r1")[-1]
    done: list[bytes] = []

    def reflect(end: End, data: bytes) -> bytes:
        if end.robot == "r0" and not done:
            done.append(data)
            return own
        return data

    watched.changes = reflect
    watched.run(3.0)
    assert watched.world.bots["r1"].counters["bad_tags"] == 1
    assert watched.world.all_up()


def test_a_frame_that_was_kept_back_ends_the_connection(watched: Watched) -> None:
    """Frames cannot be left out: the next one's counter is another."""
    dropped: list[bytes] = []

    def drop(end: End, data: bytes) -> bytes:
        if end.robot == "r0" and not dropped:
            dropped.append(data)
            return b""
        return data

    watched.changes = drop
    watched.run(3.0)
    assert dropped
    assert watched.world.bots["r1"].counters["bad_tags"] == 1


def test_bytes_that_trickle_do_not_keep_a_dead_link_alive(watched: Watched) -> None:
    """Whoever holds back the stream and lets a byte through now and then is silence all the same."""
    kept = bytearray()

    def trickle(end: End, data: bytes) -> bytes:
        if end.robot != "r0":
            return data
        kept.extend(data)
        first = bytes(kept[:1])
        del kept[:1]
        return first

    watched.changes = trickle
    watched.run(4.0)
    assert watched.world.bots["r1"].counters["silent"] == 1
    watched.changes = None
    watched.run(RECOVERY)
    assert watched.world.all_up()


# -- floods --------------------------------------------------------------------------------------------------


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
    assert len(gate._refused) == calls._MAX_REMEMBERED
    last = Caller("10.0.3.231")
    assert not gate.has_room(last, (), 0.1)
    assert gate.has_room(last, (), 0.3)
    gate.refused(last, 0.3)
    gate.confirmed(last)
    assert gate.has_room(last, (), 0.31)
    for _ in range(50):
        gate.refused(last, 1.0)
    assert gate.has_room(last, (), 1.0 + calls.LONGEST_SHUT_OUT)


# -- all at once ---------------------------------------------------------------------------------------------


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
    run_state_machine_as_test(Siege, settings=settings(max_examples=40, stateful_step_count=25, deadline=None))


@pytest.mark.slow
def test_a_mesh_withstands_many_random_strangers() -> None:
    run_state_machine_as_test(Siege, settings=settings(max_examples=300, stateful_step_count=50, deadline=None))
