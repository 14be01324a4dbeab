"""The bus service as a process: one router per runtime directory, nothing on the network, clean ends."""

import os
import signal
import socket
import stat
import subprocess
from pathlib import Path

import pytest
from conftest import Processes, open_files, stop, wait_until

from swarm.bus.zenoh_bus import Bus
from swarm.messages import Status
from swarm.messages.codec import decode


def refused(processes: Processes, **environment: str) -> str:
    """What a bus that cannot start says: one line, exit code 2."""
    process = processes.start("-m", "services.bus", **environment)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 2, errors
    assert errors.startswith("bus: ")
    assert errors.count("\n") == 1
    return errors


def inodes(pid: int) -> set[str]:
    """Inode numbers of the sockets a process holds."""
    return {file[len("socket:[") : -1] for file in open_files(pid) if file.startswith("socket:[")}


def test_nothing_listens_on_the_network(bus_service: subprocess.Popen[str], runtime: Path) -> None:
    with Bus.of(runtime) as bus:
        assert bus.wait_connected(60)
        for pid in (bus_service.pid, os.getpid()):
            own = inodes(pid)
            for table in ("tcp", "tcp6", "udp", "udp6", "raw", "raw6"):
                lines = Path(f"/proc/{pid}/net/{table}").read_text().splitlines()[1:]
                assert not own & {line.split()[9] for line in lines}, table
            listening = Path(f"/proc/{pid}/net/unix").read_text()
            assert {line.split()[6] for line in listening.splitlines()[1:]} & inodes(bus_service.pid)


def test_only_owner_and_group_may_connect(runtime: Path, bus_service: subprocess.Popen[str]) -> None:
    mode = stat.S_IMODE((runtime / "bus.sock").stat().st_mode)
    assert mode == 0o770
    assert stop(bus_service) == 0


def test_the_router_is_a_service_of_its_own_bus(bus_service: subprocess.Popen[str], runtime: Path) -> None:
    replies: list[Status] = []
    with Bus.of(runtime) as bus:

        def answered() -> bool:
            bus.ask("swarm/r0/bus/status", lambda key, p: replies.append(decode(Status, p, key)))
            return bool(replies)

        wait_until(answered)
        alive: list[str] = []
        bus.watch("swarm/r0/bus/alive", lambda key, _: alive.append(key))
        wait_until(lambda: alive)
    assert (replies[0].state, replies[0].pid) == ("ready", bus_service.pid)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_clean_stop_removes_the_socket(
    bus_service: subprocess.Popen[str], runtime: Path, number: signal.Signals
) -> None:
    with Bus.of(runtime) as bus:
        assert bus.wait_connected(60)
        bus_service.send_signal(number)
        assert bus_service.wait(60) == 0
    assert not (runtime / "bus.sock").exists()


def test_a_stale_socket_is_removed(processes: Processes, bus_service: subprocess.Popen[str], runtime: Path) -> None:
    bus_service.kill()
    bus_service.wait()
    assert (runtime / "bus.sock").exists()
    processes.router()
    with Bus.of(runtime) as bus:
        assert bus.wait_connected(60)


def test_a_stale_socket_without_any_lock_file_is_removed(processes: Processes, runtime: Path) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as sock:
        sock.bind(str(runtime / "bus.sock"))
    processes.router()


@pytest.mark.usefixtures("bus_service")
def test_a_second_bus_is_refused_and_the_first_goes_on(
    processes: Processes, bus_service: subprocess.Popen[str], runtime: Path
) -> None:
    assert f"another bus is running there (pid {bus_service.pid})" in refused(processes)
    with Bus.of(runtime) as bus:
        assert bus.wait_connected(60)
    assert bus_service.poll() is None


def test_of_several_started_at_once_one_wins(processes: Processes, runtime: Path) -> None:
    several = [processes.start("-m", "services.bus") for _ in range(4)]
    wait_until(lambda: sum(process.poll() == 2 for process in several) == 3)
    winner = next(process for process in several if process.poll() is None)
    with Bus.of(runtime) as bus:
        assert bus.wait_connected(60)
    assert stop(winner) == 0


def test_a_socket_of_another_program_is_refused(processes: Processes, runtime: Path) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as sock:
        sock.bind(str(runtime / "bus.sock"))
        sock.listen()
        assert "another program listens on this socket" in refused(processes)
    assert (runtime / "bus.sock").exists()


def test_a_file_in_the_way_is_refused_and_kept(processes: Processes, runtime: Path) -> None:
    (runtime / "bus.sock").write_text("precious")
    assert "is not a socket" in refused(processes)
    assert (runtime / "bus.sock").read_text() == "precious"


def test_the_bus_refuses_unusable_runtime_directories(processes: Processes, runtime: Path) -> None:
    assert f"{runtime}/missing cannot be used: No such file" in refused(processes, SWARM_RUNTIME=f"{runtime}/missing")
    assert "/proc cannot be used" in refused(processes, SWARM_RUNTIME="/proc")
    assert "at most 107" in refused(processes, SWARM_RUNTIME=f"{runtime}/{'x' * 100}")
    assert "cannot be used: Not a directory" in refused(processes, SWARM_RUNTIME=str(processes.config))


def test_a_config_error_leaves_no_socket(processes: Processes, runtime: Path) -> None:
    processes.config.write_text("[[robots]]\nname = 3\n")
    assert str(processes.config) in refused(processes)
    assert not (runtime / "bus.sock").exists()
