"""The process that is the radio of a simulation: its sockets and its clock, which is driven by hand here."""

import contextlib
import select
import socket
import tempfile
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from conftest import costly
from hypothesis import given
from hypothesis import strategies as st

from services.mesh.core.link.calls import Caller
from services.mesh.links import slots
from services.mesh.links.pipe import Pipe
from services.mesh.links.sim import cut_file
from services.mesh.links.slots import RADIO_SOCKET, RadioAnswer, RadioCall, RadioCut, RadioSupervise, SlotsListener
from sim.control.link_cuts import cut_link
from sim.processes.radio import LOOK_EVERY, MOST_LATE, RadioServer
from sim.slots.calls import ABSENT
from sim.slots.connections import SOCKET, End, RadioConnections
from sim.slots.parameters import SlotParameters
from sim.virtual.events import EventQueue
from swarm.errors import LocalError
from swarm.messages.codec import decode

NAMES = ("r0", "r1", "r2")
BEGAN = 1000.0
"""The clock that is driven by hand does not begin with the radio's."""


class Swarm:
    """The radio of three robots, and what their meshes have open."""

    def __init__(self, run_dir: Path) -> None:
        self.run_dir = run_dir
        self.now = BEGAN
        for name in NAMES:
            (run_dir / name).mkdir()
        self.server = self.start_radio()
        self.listeners: dict[str, SlotsListener] = {}
        self.pipes: list[Pipe] = []
        for name in NAMES:
            self.start_mesh(name)

    def start_radio(self, seed: int = 1) -> RadioServer:
        meshes = {name: self.address(name) for name in NAMES}
        self.server = RadioServer(self.run_dir, meshes, SlotParameters(), seed, self.now)
        return self.server

    def address(self, name: str) -> Path:
        return self.run_dir / name / "mesh.sock"

    def start_mesh(self, name: str) -> None:
        self.listeners[name] = SlotsListener(self.address(name), self.run_dir / name, name)
        self.run(lambda: name in self.server._meshes)
        assert self.accepted(name) is None  # the radio itself

    def accepted(self, name: str) -> Pipe | None:
        if not select.select([self.listeners[name]], [], [], 0)[0]:
            return None
        with contextlib.suppress(ConnectionError):
            pipe = self.listeners[name].accept()
            self.pipes.append(pipe)
            return pipe
        return None

    def run(self, until: Callable[[], object], seconds: float = 30.0) -> float:
        """Let time pass from one thing planned to the next until something is so; return how long it took."""
        began = self.now
        deadline = self.now
        while not until():
            readable, writable, _ = select.select(*self.server.watched(), [], 0)
            if not readable and not writable:
                self.now = max(self.now, deadline)
            assert self.now - began <= seconds, "it never was so"
            deadline = self.server.turn(self.now, readable, writable)
        return self.now - began

    def let_pass(self, seconds: float) -> None:
        ends = self.now + seconds
        with contextlib.suppress(AssertionError):
            self.run(lambda: False, seconds)
        self.now = ends

    def call(self, caller: str, called: str) -> tuple[str, socket.socket]:
        """Return the reason why there is no link, and the connection."""
        sock = slots.ask(self.run_dir / RADIO_SOCKET, RadioCall(caller, called))
        self.run(lambda: select.select([sock], [], [], 0)[0])
        return decode(RadioAnswer, sock.recv(1024), "answer").reason, sock

    def link(self, caller: str, called: str) -> tuple[Pipe, Pipe]:
        reason, sock = self.call(caller, called)
        assert reason == ""
        near, far = slots._pipe(sock), self.accepted(called)
        assert far is not None
        assert far.caller == Caller(caller, caller)
        self.pipes.append(near)
        return near, far

    def close(self) -> None:
        self.server.close()
        for each in (*self.pipes, *self.listeners.values()):
            each.close()


@pytest.fixture
def swarm(runtime: Path) -> Iterator[Swarm]:
    made = Swarm(runtime)
    yield made
    made.close()


def write(pipe: Pipe, data: bytes) -> None:
    pipe.offer(data)
    assert pipe.flush()


def received(pipe: Pipe) -> bytes | None:
    """All that can be read now; None where the other end has closed and nothing came before."""
    found = b""
    while select.select([pipe], [], [], 0)[0]:
        pipe.read(0.0)
        data = pipe.take(0.0)
        if not data:
            return found or None
        found += data
    return found


def test_a_link_carries_both_ways_and_knows_the_caller(swarm: Swarm) -> None:
    near, far = swarm.link("r0", "r1")
    write(near, b"there")
    write(far, b"back")
    got = [b"", b""]

    def both() -> bool:
        got[0] += received(far) or b""
        got[1] += received(near) or b""
        return got == [b"there", b"back"]

    assert swarm.run(both) < 0.2


class Noting(End):
    """An end that notes when something arrives."""

    def __init__(self, robot, link, clock, waiting=()):
        super().__init__(robot, link)
        self.clock, self.waiting, self.times = clock, list(waiting), []

    def take(self):
        return self.waiting.pop(0) if self.waiting else b""

    def give(self, data):
        self.times.append(self.clock.now)


def test_the_sockets_change_no_time_of_the_model(swarm: Swarm) -> None:
    """The same call and the same writes over the core alone, at the same times, arrive at the same times."""
    writes = [bytes([n]) * (700 * n) for n in range(1, 6)]
    swarm.server.close()
    swarm.start_radio(seed=7)
    began = swarm.now
    for name in NAMES:
        assert swarm.accepted(name) is None  # the new radio
    swarm.let_pass(0.05)
    asked_at = swarm.now
    near, far = swarm.link("r0", "r1")
    linked_at = swarm.now
    for data in writes:
        write(near, data)
    sizes, times = [], []

    def arrived() -> bool:
        if data := received(far):
            sizes.append(len(data))
            times.append(swarm.now - began)
        return sum(sizes) == sum(map(len, writes))

    swarm.run(arrived)

    clock = EventQueue()
    core = RadioConnections(clock, NAMES, SlotParameters(), 7)
    core.reachable.update(NAMES)
    ends = []

    def linked(link, reason):
        assert clock.now == pytest.approx(linked_at - began, abs=1e-9)
        ends.extend((Noting("r0", link, clock, writes), Noting("r1", link, clock)))
        core.join(*ends)
        core.flush(ends[0])

    clock.at(asked_at - began, core.call, "r0", "r1", linked)
    clock.run(10.0)
    assert times == pytest.approx(sorted(set(ends[1].times)), abs=1e-7)
    assert swarm.server.lateness()["late_most_s"] == pytest.approx(0.0, abs=1e-9)


def test_a_robot_without_a_mesh_is_called_in_vain_for_the_time_of_a_page(swarm: Swarm) -> None:
    swarm.listeners.pop("r1").close()
    swarm.run(lambda: "r1" not in swarm.server._meshes)
    began = swarm.now
    reason, sock = swarm.call("r0", "r1")
    sock.close()
    assert reason == ABSENT
    assert swarm.now - began == pytest.approx(SlotParameters().page_timeout, abs=LOOK_EVERY)
    swarm.start_mesh("r1")
    swarm.link("r0", "r1")


def test_a_mesh_that_ends_is_noticed_at_the_other_end_after_what_it_has_sent(swarm: Swarm) -> None:
    near, far = swarm.link("r0", "r1")
    write(near, b"last words")
    near.close()
    got = []
    swarm.run(lambda: got.append(received(far)) or got[-1] is None)
    assert b"".join(filter(None, got)) == b"last words"
    swarm.run(lambda: not swarm.server.ends)
    swarm.link("r0", "r1")  # at once: nothing is left of the first link


def test_a_caller_that_has_ended_meanwhile_leaves_no_link(swarm: Swarm) -> None:
    slots.ask(swarm.run_dir / RADIO_SOCKET, RadioCall("r0", "r1")).close()
    far = []
    swarm.run(lambda: far.append(swarm.accepted("r1")) or far[-1] is not None)
    swarm.run(lambda: received(far[-1]) is None)
    swarm.run(lambda: not swarm.server._connections.radio.devices["r0"].links)


def test_a_cut_passes_nothing_and_a_link_ends_after_its_supervision(swarm: Swarm) -> None:
    near, far = swarm.link("r0", "r1")
    radio = swarm.run_dir / RADIO_SOCKET
    slots.ask(radio, RadioSupervise("r0", "r1", 3.0)).close()
    cut_link(swarm.run_dir, "r0", "r1", 60.0)
    swarm.let_pass(0.01)
    write(near, b"lost")
    waited = swarm.run(lambda: not swarm.server.ends)
    assert waited == pytest.approx(2.0, abs=0.1)  # two thirds of 3 s
    assert received(near) is None
    assert received(far) is None
    reason, sock = swarm.call("r0", "r1")
    sock.close()
    assert reason == ABSENT
    cut_link(swarm.run_dir, "r1", "r0", 0.0)
    swarm.let_pass(0.01)
    swarm.link("r0", "r1")


def test_a_mesh_that_does_not_read_stops_the_one_that_writes(swarm: Swarm) -> None:
    near, far = swarm.link("r0", "r1")
    sent = got = 0

    def write_more() -> bool:
        nonlocal sent
        if near.flush():
            near.offer(bytes(4000))
            sent += 4000
        return False

    with contextlib.suppress(AssertionError):
        swarm.run(write_more, 10.0)
    assert not near.flush()
    assert SOCKET <= sent < 4 * SOCKET  # in 10 s it would be 30 times as much

    def whole() -> bool:
        nonlocal got
        got += len(received(far) or b"")
        return near.flush() and got == sent

    swarm.run(whole)


def test_a_busy_machine_makes_frames_late_and_loses_none(swarm: Swarm) -> None:
    near, far = swarm.link("r0", "r1")
    write(near, b"late")
    readable, _, _ = select.select(*swarm.server.watched(), [], 0)
    swarm.server.turn(swarm.now, readable)
    swarm.now += 0.5
    swarm.server.turn(swarm.now)
    assert received(far) == b"late"
    late = swarm.server.lateness()
    assert 0.4 < late["late_most_s"] < 0.5
    assert late["stood_still_s"] == 0


def test_after_a_long_time_without_the_machine_the_radio_has_stood_still(swarm: Swarm) -> None:
    near, far = swarm.link("r0", "r1")
    write(near, b"held")
    readable, _, _ = select.select(*swarm.server.watched(), [], 0)
    swarm.server.turn(swarm.now, readable)
    swarm.now += 60.0  # three times the supervision of a link
    swarm.server.turn(swarm.now)
    assert received(far) == b"held"
    assert swarm.server.lateness()["stood_still_s"] == pytest.approx(60.0 - MOST_LATE, abs=0.1)
    write(far, b"and on")
    assert swarm.run(lambda: received(near) == b"and on") < 0.2


@pytest.mark.parametrize("data", [b"", b"nonsense", b"\x81\xa1a\x01", bytes(4096)])
def test_a_request_that_is_none_is_refused_and_the_radio_goes_on(swarm: Swarm, data: bytes) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as sock:
        sock.connect(str(swarm.run_dir / RADIO_SOCKET))
        if data:
            sock.send(data)
        else:
            sock.shutdown(socket.SHUT_WR)
        swarm.run(lambda: select.select([sock], [], [], 0)[0])
        assert sock.recv(1) == b""
    swarm.link("r0", "r1")


@pytest.mark.parametrize(
    "request_", [RadioCall("r0", "r9"), RadioCall("r0", "r0"), RadioCut("r7", "r0", 1.0), RadioSupervise("a", "b", 1.0)]
)
def test_a_request_about_robots_that_are_not_there_is_refused(swarm: Swarm, request_: slots.Request) -> None:
    sock = slots.ask(swarm.run_dir / RADIO_SOCKET, request_)
    swarm.run(lambda: select.select([sock], [], [], 0)[0])
    assert sock.recv(1) == b""
    sock.close()


def test_a_radio_that_starts_anew_finds_all_meshes_and_old_links_have_ended(swarm: Swarm) -> None:
    near, far = swarm.link("r0", "r1")
    swarm.server.close()
    assert received(near) is None
    assert received(far) is None
    with pytest.raises(OSError):  # noqa: PT011 - there is no radio
        slots.dial(swarm.address("r1"), "r0", "r1")
    swarm.start_radio()
    for name in NAMES:
        assert swarm.accepted(name) is None
    swarm.link("r0", "r1")


def test_a_radio_that_ends_during_a_call_is_a_call_in_vain(runtime: Path) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as radio:
        radio.bind(str(runtime / RADIO_SOCKET))
        radio.listen(1)
        thread = threading.Thread(target=lambda: radio.accept()[0].close())
        thread.start()
        with pytest.raises(ConnectionError, match="has ended"):
            slots.dial(runtime / "r1" / "mesh.sock", "r0", "r1")
        thread.join()


def test_a_radio_that_starts_anew_goes_on_with_a_cut_that_holds(swarm: Swarm) -> None:
    cut_file(swarm.run_dir, "r1", "r0").write_text(f"{swarm.now + 60.0!r}\n")
    swarm.server.close()
    swarm.start_radio()
    swarm.let_pass(0.1)
    for name in NAMES:
        assert swarm.accepted(name) is None
    reason, sock = swarm.call("r0", "r1")
    sock.close()
    assert reason == ABSENT
    swarm.link("r0", "r2")
    swarm.let_pass(60.0)
    swarm.link("r1", "r0")


def test_a_second_mesh_of_a_robot_is_refused(swarm: Swarm) -> None:
    with pytest.raises(LocalError, match="another mesh of this robot"):
        SlotsListener(swarm.address("r0"), swarm.run_dir / "r0", "r0")


@costly(25)
@given(
    st.lists(st.tuples(st.booleans(), st.binary(min_size=1, max_size=4096), st.floats(0.0, 0.05)), max_size=12),
    st.floats(0.0, 1.5),
)
def test_whatever_is_written_when_arrives_once_and_in_order(
    writes: list[tuple[bool, bytes, float]], pause: float
) -> None:
    folder = tempfile.TemporaryDirectory(prefix="sw", dir="/tmp")
    swarm = Swarm(Path(folder.name))
    try:
        near, far = swarm.link("r0", "r1")
        wanted: dict[bool, bytes] = {False: b"", True: b""}
        got = {False: b"", True: b""}

        def look() -> bool:
            for back, pipe in ((False, far), (True, near)):
                got[back] += received(pipe) or b""
            return got == wanted

        for back, data, seconds in writes:
            pipe = far if back else near
            swarm.run(pipe.flush)
            pipe.offer(data)
            pipe.flush()
            wanted[back] += data
            swarm.let_pass(seconds)
            look()
        swarm.now += pause  # the machine has no time for the radio
        swarm.run(lambda: (near.flush(), far.flush(), look())[-1])
    finally:
        swarm.close()
        folder.cleanup()
