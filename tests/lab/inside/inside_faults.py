"""Inside a machine: what the mesh's RFCOMM links do at each fault of a real kernel's sockets."""

import errno
import os
import select
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from inside_radio import SUPERVISION, adapters, bring_up, hci

from lab.radio.remote import Radio
from lab.waiting import Wait, readable, until
from services.mesh.links import rfcomm, supervision
from services.mesh.links.pipe import Pipe
from swarm import clock
from swarm.bluetooth import hci as swarm_hci
from swarm.bluetooth.adapter import Adapter
from swarm.errors import LocalError

CHANNEL = 3
PASSING = (errno.EBUSY, errno.ECONNREFUSED, errno.EHOSTDOWN, errno.EALREADY, errno.ECONNRESET)
"""Errors of a dial that end when an earlier connection or its adapter's absence has ended. A call that meets the end of
the session of the one before is reset with it."""

PATIENT = 20.0
"""s: a supervision time that no busy host reaches by chance."""
CONNECTIONS = 1000

Pair = tuple[Pipe, Pipe]


def mine(radio: Radio, number: int, channel: int = CHANNEL) -> rfcomm.Radio:
    return rfcomm.Radio(radio.addresses[number], channel)


@pytest.fixture
def listener(radio: Radio) -> Iterator[rfcomm.RfcommListener]:
    made = rfcomm.RfcommListener(mine(radio, 1), {radio.addresses[0].lower(): "r0"})
    yield made
    made.close()


def accept(listener: rfcomm.RfcommListener) -> Pipe:
    readable("a call arrives", listener)
    return listener.accept()


def dial(radio: Radio, caller: int = 0, called: int = 1) -> Pipe:
    """As the mesh does it: again, while an earlier connection has not ended yet."""
    last: OSError | None = None
    wait = Wait(f"the call of {called} by {caller} succeeds", state=lambda: last)
    while True:
        try:
            return rfcomm.dial(mine(radio, caller), radio.addresses[called])
        except OSError as error:
            if error.errno not in PASSING:
                raise
            last = error
        wait.look()
        time.sleep(0.02)


def connect(radio: Radio, listener: rfcomm.RfcommListener) -> Pair | None:
    """The caller's and the called one's pipe, when a byte has come through; None for a call that was reset with the
    session of the one before, which happens after calls were accepted, too."""
    caller = dial(radio)
    called = accept(listener)
    write(caller, b"x")
    if read(called) == b"x":
        return caller, called
    close(caller, called)
    return None


def close(*pipes: Pipe) -> None:
    for pipe in pipes:
        pipe.shutdown()
        pipe.close()


@pytest.fixture
def pair(radio: Radio, listener: rfcomm.RfcommListener) -> Iterator[Pair]:
    """A connection: the caller's and the called one's pipe."""
    made = until("a call gets through", lambda: connect(radio, listener))
    yield made
    close(*made)


def read(pipe: Pipe) -> bytes:
    """What the mesh's thread gets next: it selects, reads and takes, and looks again when `next_change` says so."""
    wait = Wait("bytes or the end of the connection arrive")
    while True:
        now = clock.now()
        if (data := pipe.take(now)) is not None:
            return data
        if pipe.wants_read(now) and select.select([pipe], [], [], min(wait.look(), 0.5))[0]:
            pipe.read(now)


def write(pipe: Pipe, data: bytes) -> bool:
    pipe.offer(data)
    return pipe.flush()


def ended(pipe: Pipe) -> str:
    """Why it ended; and it is not read again, since a second read never returns."""
    assert read(pipe) == b""
    assert not pipe.wants_read(clock.now())
    assert pipe.take(clock.now()) is None
    return pipe.fault


def test_bytes_go_both_ways_and_the_caller_is_known(radio: Radio, pair: Pair) -> None:
    caller, called = pair
    assert (called.caller.source, called.caller.robot) == (radio.addresses[0], "r0")
    assert write(caller, b"there")
    assert read(called) == b"there"
    assert write(called, b"back")
    assert read(caller) == b"back"


def test_the_other_end_closed_what_it_said_before_still_arrives(pair: Pair) -> None:
    caller, called = pair
    assert write(called, b"last words")
    called.shutdown()
    called.close()
    assert read(caller) == b"last words"
    assert ended(caller) in ("", "connection reset by peer")


def test_the_other_process_killed(radio: Radio, listener: rfcomm.RfcommListener) -> None:
    accepted, accepts = os.pipe()
    child = os.fork()
    if child == 0:
        pipes = []
        while len(pipes) < CONNECTIONS:  # a call that met the end of the connection before is made again
            pipes.append(accept(listener))
            os.write(accepts, b"x")
        os._exit(0)
    caller = dial(radio)
    readable("the other process accepts the call", accepted)
    os.kill(child, 9)
    os.waitpid(child, 0)
    os.close(accepted)
    os.close(accepts)
    assert ended(caller) in ("", "connection reset by peer")
    caller.close()


def test_who_writes_after_the_end_learns_it_and_the_reader_too(pair: Pair) -> None:
    caller, called = pair
    called.shutdown()
    called.close()
    wait = Wait("the writer learns of the end")
    caller.offer(b"x")
    while not caller.fault:
        wait.look()
        # False: the kernel's buffer is full, since the end takes its time to get here and we write faster.
        if caller.flush():
            caller.offer(b"x")
    assert caller.fault
    assert ended(caller)


def test_a_lost_link_ends_both_pipes(radio: Radio, pair: Pair) -> None:
    radio.order("drop", one=radio.addresses[0], other=radio.addresses[1])
    for pipe in pair:
        assert ended(pipe) == "connection timed out"


def test_silence_first_takes_writes_then_blocks_and_ends_by_the_supervision_time(radio: Radio, pair: Pair) -> None:
    caller, _ = pair
    began = time.monotonic()
    radio.order("cut", one=radio.addresses[0], other=radio.addresses[1])
    taken = 0
    while write(caller, bytes(900)):
        taken += 1
        assert taken < 200, "the kernel takes everything"
    assert taken >= 20  # about 51 of them on an unloaded machine
    for pipe in pair:
        assert ended(pipe) == "connection timed out"
    assert time.monotonic() - began >= SUPERVISION - 0.5


def test_a_short_silence_costs_nothing(radio: Radio, pair: Pair) -> None:
    caller, called = pair
    radio.order("change", supervision=1000.0)
    radio.order("cut", one=radio.addresses[0], other=radio.addresses[1])
    assert write(caller, b"through a cut")
    assert not select.select([called], [], [], 1.0)[0]
    radio.order("mend", one=radio.addresses[0], other=radio.addresses[1])
    assert read(called) == b"through a cut"


@pytest.mark.parametrize("limit", [None, 1.0])
def test_a_silent_robot_takes_the_buffers_of_its_neighbours_until_its_connection_is_over(
    radio: Radio, listener: rfcomm.RfcommListener, pair: Pair, limit: float | None
) -> None:
    """A controller has eight for all its connections; the mesh's limit on silence lets the others have them back."""
    other = rfcomm.RfcommListener(mine(radio, 2), {})
    silent = dial(radio, 0, 2)
    called = accept(other)
    for _ in range(20):  # until it may have more under way than RFCOMM's seven of the beginning
        assert write(silent, b"x")
        assert read(called) == b"x"
    adapter = Adapter(radio.addresses[0])
    if limit is not None:
        radio.order("change", supervision=PATIENT)
        supervision.limit(adapter, radio.addresses[2], limit)
    began = time.monotonic()
    radio.order("silence", address=radio.addresses[2])
    wait = Wait("the living robot hears us")
    for _ in range(12):
        assert write(silent, bytes(900))
    caller, living = pair
    while not select.select([living], [], [], 0.2)[0]:
        # The kernel looks for what waits only when more is written, as the mesh's heartbeats are.
        assert write(caller, b"to the living")
        wait.look()
    took = time.monotonic() - began
    if limit is None:
        assert took > SUPERVISION - 0.5, "the kernel serves all links alike by now: the limit is needless"
    else:
        assert took < PATIENT / 2
    assert ended(silent) == "connection timed out"
    adapter.close()
    close(silent, called)
    other.close()


def test_a_link_goes_on_when_a_silent_one_of_the_same_adapter_has_ended(
    radio: Radio, listener: rfcomm.RfcommListener, pair: Pair
) -> None:
    """Linux 6.12 gives the silent link's buffers back without sending what waits for them. A link with used-up credits,
    which writes nothing by itself, stayed silent for 40 s and more."""
    caller, living = pair
    other = rfcomm.RfcommListener(mine(radio, 2), {})
    silent = dial(radio, 0, 2)
    called = accept(other)
    for _ in range(20):  # until it may have more under way than RFCOMM's seven of the beginning
        assert write(silent, b"x")
        assert read(called) == b"x"
    radio.order("silence", address=radio.addresses[2])
    for _ in range(12):
        assert write(silent, bytes(900))
    time.sleep(0.5)  # until the kernel's thread has handed eight of them to the controller, which nothing tells
    while write(caller, bytes(900)):
        pass
    assert ended(silent) == "connection timed out"
    assert not select.select([living], [], [], 1.0)[0], "the kernel sends on by itself by now: `nudge` is needless"
    caller.nudge()
    assert read(living)
    close(silent, called)
    other.close()


def test_only_the_central_limits_silence(radio: Radio, pair: Pair) -> None:
    adapter = Adapter(radio.addresses[1])
    command = swarm_hci.write_supervision(adapter.handle(radio.addresses[0]), 1.0)
    assert adapter.ask(command, swarm_hci.written_supervision) == 0x0C
    with pytest.raises(LocalError, match="no Bluetooth connection to 00:11:22:33:44:55"):
        supervision.limit(adapter, "00:11:22:33:44:55", 1.0)
    adapter.close()


@pytest.mark.parametrize("how", ["absent", "out of range"])
def test_a_robot_that_is_not_there(radio: Radio, how: str) -> None:
    called = "00:11:22:33:44:55"
    if how == "out of range":
        called = radio.addresses[4]
        radio.order("place", address=radio.addresses[3], x=0.0, y=0.0)
        radio.order("place", address=called, x=50.0, y=0.0)
        radio.order("change", range=10.0)
    began = time.monotonic()
    with pytest.raises(OSError, match="not in range, switched off") as caught:
        rfcomm.dial(mine(radio, 3), called)
    assert caught.value.errno == errno.EHOSTDOWN
    assert 4.0 < time.monotonic() - began < rfcomm.DIAL_TIMEOUT
    radio.order("change", range=1000.0)


def test_a_call_where_nobody_listens_is_refused_by_name(radio: Radio) -> None:
    with pytest.raises(OSError, match="no mesh listens there on that channel") as caught:
        rfcomm.dial(mine(radio, 0, 9), radio.addresses[2])
    assert caught.value.errno == errno.ECONNREFUSED


def test_the_same_pair_and_channel_again(radio: Radio, pair: Pair) -> None:
    with pytest.raises(OSError, match="an earlier connection") as caught:
        rfcomm.dial(mine(radio, 0), radio.addresses[1])
    assert caught.value.errno == errno.EBUSY


def test_a_channel_in_use(radio: Radio, listener: rfcomm.RfcommListener) -> None:
    with pytest.raises(LocalError, match="something else listens on that channel"):
        rfcomm.RfcommListener(mine(radio, 1), {})


def test_a_missing_adapter_is_named_by_the_error_of_a_dial(radio: Radio) -> None:
    wrong = rfcomm.Radio("00:11:22:33:44:66", CHANNEL)
    with pytest.raises(OSError, match="the own Bluetooth adapter is not there") as caught:
        rfcomm.dial(wrong, radio.addresses[0])
    assert caught.value.errno == errno.EHOSTUNREACH


def test_both_call_at_once_which_is_why_one_fixed_side_calls(radio: Radio) -> None:
    """Without a link below them both pages are unheard; whatever they come to, neither hangs, and then one works."""
    listeners = [rfcomm.RfcommListener(mine(radio, number), {}) for number in (4, 5)]
    results: list[str] = []

    def call(me: int, other: int) -> None:
        try:
            pipe = rfcomm.dial(mine(radio, me), radio.addresses[other])
        except OSError as error:
            results.append(errno.errorcode[error.errno or 0])
        else:
            results.append("connected")
            close(pipe)

    threads = [threading.Thread(target=call, args=pair) for pair in ((4, 5), (5, 4))]
    for thread in threads:
        thread.start()
    for thread in threads:
        until("both calls come to an end", lambda thread=thread: not thread.is_alive(), state=lambda: results)
    assert len(results) == 2
    assert set(results) <= {"connected", "EHOSTDOWN", "EBUSY", "EALREADY"}
    time.sleep(0.2)
    pipe = dial(radio, 4, 5)
    accept(listeners[1]).close()
    pipe.close()
    for each in listeners:
        each.close()


@pytest.mark.parametrize("how", ["down and up", "unplugged"])
def test_an_adapter_that_goes_and_comes_back(
    radio: Radio, listener: rfcomm.RfcommListener, pair: Pair, how: str
) -> None:
    caller, called = pair
    address = radio.addresses[1]
    if how == "unplugged":
        radio.order("unplug", address=address)
        radio.order("plug", address=address)
        assert ended(caller) == "connection timed out"
        assert ended(called)
    else:
        hci(adapters()[address], "down")
        assert ended(called) == "software caused connection abort"
        # The lab's controller finds out that its host has switched it off when it has something for it, and says no
        # more then: the mesh's sign of life, for one.
        write(caller, b"are you there")
        assert ended(caller) == "connection timed out"
    bring_up(radio)
    close(*until("a call gets through as before", lambda: connect(radio, listener)))


def resident() -> int:
    """kB of this process."""
    return int(Path("/proc/self/status").read_text().split("VmRSS:")[1].split()[0])


def unreclaimable() -> int:
    """kB of the kernel's own objects that it cannot give back."""
    return int(Path("/proc/meminfo").read_text().split("SUnreclaim:")[1].split()[0])


def test_a_thousand_connections_leave_nothing_behind(radio: Radio, listener: rfcomm.RfcommListener) -> None:
    calls = 0

    def once() -> None:
        """Until one gets through: some calls are reset with the session of the one before, also after they were
        accepted."""
        nonlocal calls
        found = None
        while found is None:
            calls += 1
            found = connect(radio, listener)
        caller, called = found
        close(called)
        ended(caller)
        caller.close()

    def state() -> tuple[int, int, int]:
        return len(list(Path("/proc/self/fd").iterdir())), resident(), unreclaimable()

    for _ in range(50):
        once()
    descriptors, memory, slab = state()
    calls = 0
    for _ in range(CONNECTIONS):
        once()
    after, memory_after, slab_after = state()
    sys.stdout.write(f"\n{calls} calls, {memory_after - memory} kB, kernel {slab_after - slab} kB ")
    assert calls < 1.1 * CONNECTIONS
    assert after == descriptors
    assert memory_after - memory < 2000
    assert slab_after - slab < 10_000
