"""The bus adapter over its router's absence, stop, death and restart."""

import contextlib
import os
import signal
import socket
import stat
import subprocess
import threading
import time
from pathlib import Path

import pytest
from bus_samples import HELD_UP, Open, Samples, talk
from conftest import Processes, wait_until

from swarm.bus import zenoh_bus
from swarm.bus.zenoh_bus import Bus
from swarm.process.paths import ENDPOINT_PROTOCOL, bus_endpoint

pytest_plugins = ("bus_fixtures",)

COMMAND = """
import atexit
from swarm.bus.zenoh_bus import Bus
from swarm.errors import LocalError
from swarm.onboard.command_line import end_with
from swarm.process.paths import runtime_dir

def run():
    with Bus.of(runtime_dir()) as bus:
        print("looks")
        assert not bus.wait_connected(0.5)
    raise LocalError("no bus")

atexit.register(print, "the interpreter ends")
end_with("swarm", run)
"""


def test_declared_before_the_router_is_there(open_bus: Open, processes: Processes) -> None:
    alice, bob = open_bus(), open_bus()
    samples = Samples()
    bob.subscribe("swarm/**", samples)
    alice.publish("swarm/r0/test/x", b"lost")
    assert not alice.connected
    assert not alice.wait_connected(0.0)
    processes.router()
    assert alice.wait_connected(60)
    talk(alice, "swarm/r0/test/x", samples)


def test_everything_works_again_after_the_router_was_killed(
    open_bus: Open, processes: Processes, bus_service: subprocess.Popen[str]
) -> None:
    alice, bob = open_bus(), open_bus()
    changes: list[bool] = []
    alice.on_change(changes.append)
    samples, replies, tokens = Samples(), Samples(), Samples()
    bob.subscribe("swarm/r0/test/**", samples)
    bob.serve("swarm/r0/test/question", lambda *_: b"answer")
    bob.announce("swarm/r0/test/alive")
    alice.watch("swarm/*/*/alive", tokens)
    for round_ in (1, 2):
        talk(alice, "swarm/r0/test/x", samples)

        def answered() -> bool:
            alice.ask("swarm/r0/test/question", replies, timeout_s=0.2)
            return bool(replies)

        wait_until(answered)
        wait_until(lambda: tokens and tokens[-1][1], what="token")
        wait_until(lambda: changes and changes[-1], what="on_change")
        bus_service.kill()
        bus_service.wait()
        wait_until(lambda: not alice.connected and not bob.connected)
        wait_until(lambda: not tokens[-1][1], what="token gone")
        wait_until(lambda: not changes[-1], what="on_change")
        for _ in range(200):
            alice.publish("swarm/r0/test/lost", b"lost")
        samples.clear()
        replies.clear()
        bus_service = processes.router()
        wait_until(lambda: alice.connected and bob.connected, what=f"reconnect {round_}")
    talk(alice, "swarm/r0/test/x", samples)
    assert ("swarm/r0/test/lost", b"lost") not in samples


def test_on_change_tells_the_present_state_once(open_bus: Open, bus_service: subprocess.Popen[str]) -> None:
    bus = open_bus()
    assert bus.wait_connected(60)
    changes: list[bool] = []
    bus.on_change(changes.append)
    assert changes == [True]
    bus_service.kill()
    wait_until(lambda: changes == [True, False])


def test_a_stopped_router_does_not_hold_up_a_publisher(open_bus: Open, bus_service: subprocess.Popen[str]) -> None:
    alice, bob = open_bus(), open_bus()
    samples = Samples()
    bob.subscribe("swarm/**", samples)
    talk(alice, "swarm/r0/test/x", samples)
    bus_service.send_signal(signal.SIGSTOP)
    held_up = 0
    for _ in range(300):
        started = time.monotonic()
        alice.publish("swarm/r0/test/y", bytes(60000))
        held_up += time.monotonic() - started > HELD_UP
        assert held_up < 3
    bus_service.send_signal(signal.SIGCONT)
    talk(alice, "swarm/r0/test/x", samples, b"again")


def test_a_command_ends_in_order_while_its_session_is_still_being_opened(
    processes: Processes, bus_service: subprocess.Popen[str]
) -> None:
    """A router that is stopped takes the connection and does not answer. A thread that came back from Zenoh while the
    interpreter ends would abort the command."""
    bus_service.send_signal(signal.SIGSTOP)
    command = processes.start("-c", COMMAND)
    said, error = command.communicate(timeout=60)
    bus_service.send_signal(signal.SIGCONT)
    assert (command.returncode, said, error) == (2, "looks\n", "swarm: no bus\n")


def test_a_bus_without_a_router_can_be_closed(runtime: Path) -> None:
    # It would wait without end for one: the suite's time-out tells.
    with Bus.of(runtime) as bus:
        bus.subscribe("swarm/**", lambda *_: None)
    bus.close()
    bus.publish("swarm/r0/test/x", b"after the end")
    bus.ask("swarm/r0/test/x", lambda *_: None)


def test_the_process_ends_while_no_router_is_there(processes: Processes, runtime: Path) -> None:
    code = "import sys; from swarm.bus.zenoh_bus import Bus; b = Bus(sys.argv[1]); b.announce('swarm/a/b/c'); b.close()"
    process = processes.start("-c", code, bus_endpoint(runtime))
    _, errors = process.communicate(timeout=60)
    assert (process.returncode, errors) == (0, "")


def test_direct_sessions_hear_each_other_through_a_routers_death_and_a_client_hears_each_message_once(
    processes: Processes, runtime: Path
) -> None:
    """Mesh and apps are such sessions. They find each other by the router, and one that comes anew does, too."""
    bus_service = processes.router()
    heard, watched, again = Samples(), Samples(), Samples()
    with Bus.of(runtime, "mesh") as mesh, Bus.of(runtime) as client:
        mesh.subscribe("swarm/r0/app/**", heard)
        client.subscribe("swarm/r0/app/**", watched)
        with Bus.of(runtime, "app/x") as app:
            talk(app, "swarm/r0/app/x/a", heard)
            talk(app, "swarm/r0/app/x/b", watched)
            for number in range(50):
                app.publish("swarm/r0/app/x/c", b"%d" % number)
            for samples in (heard, watched):
                wait_until(lambda: ("swarm/r0/app/x/c", b"49") in samples, what="the messages")  # noqa: B023
                told = [int(payload) for key, payload in samples if key.endswith("/c")]
                assert told == list(range(50))
            bus_service.kill()
            bus_service.wait()
            wait_until(lambda: not app.connected, what="the router's death")
            talk(app, "swarm/r0/app/x/d", heard)
            assert ("swarm/r0/app/x/d", b"hello") not in watched
            processes.router()
            wait_until(lambda: app.connected and mesh.connected and client.connected, what="the new router")
            talk(app, "swarm/r0/app/x/e", watched)
        with Bus.of(runtime, "app/x") as app:
            mesh.subscribe("swarm/r0/app/x/f", again)
            talk(app, "swarm/r0/app/x/f", again)
            assert app.wait_connected(60)


def break_connections(socket_name: str) -> int:
    """Shut down all connections of this process to or from a Unix socket of that name, and return how many there
    were."""
    found = 0
    for number in [int(entry.name) for entry in Path("/proc/self/fd").iterdir()]:
        with contextlib.suppress(OSError):
            if not stat.S_ISSOCK(os.fstat(number).st_mode):
                continue
            with socket.socket(fileno=os.dup(number)) as connection:
                ends = (connection.getsockname(), connection.getpeername())
                if any(str(end).endswith(f"/{socket_name}") for end in ends):
                    connection.shutdown(socket.SHUT_RDWR)
                    found += 1
    return found


@pytest.mark.usefixtures("bus_service")
@pytest.mark.parametrize("one", ["mesh", "app/y"])
def test_direct_sessions_hear_each_other_again_after_their_connection_broke(runtime: Path, one: str) -> None:
    heard, answers = Samples(), Samples()
    with Bus.of(runtime, one) as peer, Bus.of(runtime, "app/x") as app:
        peer.subscribe("swarm/r0/app/x/a", heard)
        app.subscribe(f"swarm/r0/{one}/a", answers)
        assert app.wait_connected(60)
        for number in range(6):
            talk(app, "swarm/r0/app/x/a", heard, b"%d" % number)
            talk(peer, f"swarm/r0/{one}/a", answers, b"%d" % number)
            wait_until(
                lambda: break_connections(f"bus.{one.replace('/', '.')}.sock") + break_connections("bus.app.x.sock"),
                what="a connection that can be broken",
            )
            assert app.connected


def test_a_direct_session_without_a_router_is_closed_at_once(runtime: Path) -> None:
    begin = time.monotonic()
    for _ in range(5):
        bus = Bus.of(runtime, "mesh")
        assert not bus.connected
        bus.close()
    assert time.monotonic() - begin < HELD_UP


def test_close_waits_for_a_session_that_is_still_being_opened_at_a_router(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A thread that comes back from Zenoh while the interpreter ends aborts the process."""
    answered = threading.Event()

    def slow(config: object) -> None:
        assert answered.wait(60.0)
        raise zenoh_bus.zenoh.ZError("the router has gone")

    monkeypatch.setattr(zenoh_bus.zenoh, "open", slow)
    (tmp_path / "bus.sock").touch()
    bus = Bus(f"{ENDPOINT_PROTOCOL}/{tmp_path / 'bus.sock'}")
    closing = threading.Thread(target=bus.close)
    closing.start()
    closing.join(0.1)
    assert closing.is_alive()
    answered.set()
    closing.join(60.0)
    assert not closing.is_alive()
    assert not bus._opener.is_alive()


def test_close_ends_at_once_where_no_router_has_come(tmp_path: Path) -> None:
    bus = Bus(f"{ENDPOINT_PROTOCOL}/{tmp_path / 'bus.sock'}")
    bus.close()
    assert not bus._opener.is_alive()


@pytest.mark.slow
def test_clients_and_router_close_beside_connections_that_never_get_done(runtime: Path) -> None:
    """Zenoh gives up waiting for them after 10 s, and says so; both close well all the same."""
    with socket.socket(socket.AF_UNIX) as stopped_mesh, socket.socket(socket.AF_UNIX) as stopped_client:
        stopped_mesh.bind(str(runtime / "bus.mesh.sock"))
        stopped_mesh.listen()
        with zenoh_bus.Router(bus_endpoint(runtime)), Bus.of(runtime, "app-a") as app:
            stopped_client.connect(str(runtime / "bus.sock"))
            samples = Samples()
            app.subscribe("swarm/r0/test/x", samples)
            with Bus.of(runtime) as other:
                assert other.wait_connected(60)
                talk(other, "swarm/r0/test/x", samples)
