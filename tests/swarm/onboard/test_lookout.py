"""A robot's lookout: commands never wait for telemetry, and whatever comes in or waits to go out is bounded."""

import fcntl
import os
import struct
import subprocess
import termios
import tracemalloc
from pathlib import Path

import msgpack
import pytest
from conftest import Processes, wait_until
from hypothesis import given
from hypothesis import strategies as st

from swarm.bus.zenoh_bus import Bus
from swarm.errors import LocalError, PayloadError
from swarm.messages import Arm, Stop, read
from swarm.messages.codec import MAX_PAYLOAD, encode
from swarm.onboard.lookout import MAX_COMMAND, MAX_KEYS, MAX_WAITING, Lookout, publish, unpacked
from swarm.process.paths import BUS_SOCKET

FLOOD = bytes(60_000)


def waiting_bytes(process: subprocess.Popen[str]) -> int:
    """Bytes in the pipe behind a process' output, which nobody has read."""
    assert process.stdout is not None
    answer = fcntl.ioctl(process.stdout.fileno(), termios.FIONREAD, bytes(4))
    return int(struct.unpack("i", answer)[0])


def room(process: subprocess.Popen[str]) -> int:
    """Bytes that the pipe behind a process' output holds."""
    assert process.stdout is not None
    return int(fcntl.fcntl(process.stdout.fileno(), fcntl.F_GETPIPE_SZ))


@pytest.mark.usefixtures("router")
def test_lookout_publishes_a_stop_at_once_while_nobody_reads_its_telemetry(processes: Processes, runtime: Path) -> None:
    heard: list[object] = []
    with Bus.of(runtime) as bus:
        bus.subscribe("swarm/stop", lambda key, payload: heard.append(read(key, payload)))
        lookout = processes.start("-m", "swarm.onboard.lookout", "r0")
        assert lookout.stdin is not None

        def full() -> bool:
            for number in range(8):
                bus.publish(f"swarm/r0/app/out{number}", FLOOD)
            return waiting_bytes(lookout) == room(lookout)

        wait_until(full, what="the pipe behind the telemetry is full")
        payload = msgpack.packb({"t": 1.0, "origin": "r0", "reason": "x"})
        os.write(lookout.stdin.fileno(), msgpack.packb(["swarm/stop", payload]))
        wait_until(lambda: heard, what="the stop is on the bus")
        assert isinstance(heard[0], Stop)
        assert waiting_bytes(lookout) == room(lookout)  # and still nobody has read anything

        lookout.stdin.close()
        assert lookout.wait(60.0) == 0


def test_a_single_command_waits_for_a_bus_that_is_found_late(processes: Processes, runtime: Path) -> None:
    heard: list[str] = []
    processes.router()
    with Bus.of(runtime) as bus:
        bus.subscribe("swarm/r0/mesh/set/hold", lambda key, payload: heard.append(key))
        assert bus.wait_connected(60.0)
        there, away = runtime / BUS_SOCKET, runtime / "away"
        there.rename(away)
        lookout = processes.start("-m", "swarm.onboard.lookout", "r0")
        assert lookout.stdin is not None
        assert lookout.stdout is not None
        os.write(lookout.stdin.fileno(), msgpack.packb(["swarm/r0/mesh/set/hold", b"now"]))
        lookout.stdin.close()
        assert os.read(lookout.stdout.fileno(), 100).startswith(msgpack.packb(["bus", False]))
        away.rename(there)
        wait_until(lambda: heard, what="the command is on the bus")
        assert lookout.wait(60.0) == 0


@pytest.mark.usefixtures("router")
def test_lookout_ends_when_nobody_can_read_its_telemetry_any_more(processes: Processes) -> None:
    lookout = processes.start("-m", "swarm.onboard.lookout", "r0")
    assert lookout.stdout is not None
    os.read(lookout.stdout.fileno(), 1)
    lookout.stdout.close()
    with Bus.of(processes.runtime) as bus:
        wait_until(lambda: bus.publish("swarm/r0/mesh/x", b"\0") or lookout.poll() is not None)
    assert lookout.returncode == 0


@pytest.mark.usefixtures("router")
@pytest.mark.parametrize(
    "garbage", [b"\xc1", b"\x91" * 4000, b"\xa4\xff\xff\xff\xff", b"\x81\x90\x90", b"\xc9" + b"\xff" * 4]
)
def test_lookout_ends_with_a_reason_where_its_input_is_no_msgpack(processes: Processes, garbage: bytes) -> None:
    lookout = processes.start("-m", "swarm.onboard.lookout", "r0")
    assert lookout.stdin is not None
    os.write(lookout.stdin.fileno(), garbage)
    assert lookout.stderr is not None
    said = lookout.stderr.read()
    assert lookout.wait(60.0) == 1
    assert said.startswith("lookout: the input is no sequence of commands")
    assert "Traceback" not in said


@pytest.mark.parametrize("header", [b"\xdc\xff\xff", b"\xdd\x00\x00\xff\xff"])
def test_nested_lists_that_claim_a_length_take_no_memory_for_it(header: bytes) -> None:
    tracemalloc.start()
    try:
        with pytest.raises(PayloadError):
            list(unpacked([header * 500], MAX_COMMAND))
        assert tracemalloc.get_traced_memory()[1] < 2 << 20  # an unpacker's buffer has 1 MiB
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("begin", [b"\x9f" * 500, b"\xc6\x00\xff\xff\xff"])
def test_a_value_without_an_end_is_refused_once_it_is_too_long(begin: bytes) -> None:
    left = iter([begin] + [b"\x9f" + b"\x90" * 15] * 1000)
    with pytest.raises(PayloadError, match="a value is longer than 4096 bytes"):
        list(unpacked(left, MAX_COMMAND))
    assert len(list(left)) >= 1000 - MAX_COMMAND // 16


@given(st.lists(st.lists(st.binary(max_size=50), max_size=3), max_size=20), st.integers(1, 60))
def test_values_come_out_of_a_stream_however_it_is_cut(values: list[list[bytes]], size: int) -> None:
    stream = b"".join(map(msgpack.packb, values))
    parts = [stream[at : at + size] for at in range(0, len(stream), size)]
    assert list(unpacked(parts, max(len(msgpack.packb(each)) for each in [*values, []]))) == values


class Taker:
    """A bus that takes what a real one takes."""

    def __init__(self) -> None:
        self.taken: list[str] = []
        self.arms: list[Arm] = []

    def publish(self, key: str, message: object, *, urgent: bool = False) -> None:
        if len(key) > 255:
            raise LocalError("too long")
        self.taken.append(key)
        if isinstance(message, Arm):
            self.arms.append(message)


ANYTHING = st.recursive(
    st.none() | st.integers() | st.floats() | st.text() | st.binary() | st.just("swarm/stop"),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=3), inner, max_size=3),
    max_leaves=6,
)


@given(
    ANYTHING
    | st.tuples(st.text().map("swarm/".__add__), st.binary()).map(list)
    | st.tuples(st.just("swarm/r0/mesh/set/arm"), st.binary(), st.floats()).map(list)
)
def test_lookout_publishes_commands_with_plain_keys_and_nothing_else(command: object) -> None:
    bus = Taker()
    publish(bus, command)  # type: ignore[arg-type]
    for key in bus.taken:
        assert key == "swarm/stop" or (key.isascii() and key.isprintable() and "*" not in key)


@pytest.mark.parametrize(("under_way", "age"), [(0.0, 2.0), (40.0, 42.0), (-3.0, 2.0)])
def test_the_end_of_a_stop_that_a_network_held_up_is_as_old_as_it_is(
    monkeypatch: pytest.MonkeyPatch, under_way: float, age: float
) -> None:
    """Else it would take back a stop that was given meanwhile."""
    monkeypatch.setattr("swarm.onboard.lookout.clock.now", lambda: 1000.0)
    bus = Taker()
    publish(bus, ["swarm/r0/mesh/set/arm", encode(Arm(5.0, "r0", 2.0)), 1000.0 - under_way])  # type: ignore[arg-type]
    assert bus.arms == [Arm(5.0, "r0", age)]


@given(st.lists(st.tuples(st.integers(0, 2 * MAX_KEYS), st.integers(0, 2 * MAX_PAYLOAD)), max_size=30), st.data())
def test_waiting_telemetry_is_bounded_in_keys_and_bytes_and_the_newest_counts(
    samples: list[tuple[int, int]], data: st.DataObject
) -> None:
    lookout, newest = Lookout(), dict[str, bytes]()
    for number, size in samples * 4:
        name = f"swarm/r0/app/k{number}"
        lookout.take(name, bytes(size))
        if size <= MAX_PAYLOAD:
            newest[name] = bytes(size)
        if data.draw(st.booleans()):
            news = lookout.news()
            assert len(news) <= MAX_WAITING + 64 * MAX_KEYS
            unpacker = msgpack.Unpacker(max_buffer_size=2 * MAX_WAITING)
            unpacker.feed(news)
            for kind, key, payload in unpacker:
                assert kind == "key"
                assert len(payload) <= MAX_PAYLOAD
                assert payload == newest[key] or sum(map(len, newest.values())) > MAX_WAITING
            newest.clear()


def test_a_flood_of_new_keys_tokens_and_senders_does_not_fill_the_memory() -> None:
    lookout = Lookout()
    for number in range(2 * MAX_KEYS):
        lookout.take(f"swarm/r0/app/k{number}", b"")
        lookout.alive(f"swarm/r0/x{number}/alive", True)
        lookout.passed(f"r{number}", 1)
    unpacker = msgpack.Unpacker()
    unpacker.feed(lookout.news())
    assert len(list(unpacker)) == 3 * MAX_KEYS
    assert lookout.news() == b""
