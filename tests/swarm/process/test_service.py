"""The life cycle of a service as a process: states, systemd, signals, death of the parent, bad input."""

import contextlib
import logging
import os
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace

import pytest
from conftest import Processes, stop, wait_until

from swarm.bus.zenoh_bus import Bus
from swarm.messages import Status
from swarm.messages.codec import decode
from swarm.process import log, service
from swarm.process.service import FEED_S, notify

SERVICE = """
import sys, threading
from swarm.process.service import Service, run

def main():
    with Service("test") as service:
        service.counters["dropped"] += 3
        service.counters["never"] += 0
        def obey():
            for line in sys.stdin:
                verb, _, argument = line.strip().partition(" ")
                getattr(service, verb)(*([argument] if argument else []))
        threading.Thread(target=obey, daemon=True).start()
        service.ready()
        service.stopping.wait()

run(main)
"""


@pytest.fixture
def bus(runtime: Path) -> Iterator[Bus]:
    with Bus.of(runtime) as bus:
        yield bus


@contextlib.contextmanager
def systemd(runtime: Path) -> Iterator[socket.socket]:
    """The socket systemd listens on for sd_notify."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sock:
        sock.bind(str(runtime / "systemd"))
        sock.settimeout(60)
        yield sock


def tell(process: subprocess.Popen[str], command: str) -> None:
    assert process.stdin is not None
    process.stdin.write(command + "\n")
    process.stdin.flush()


@pytest.mark.usefixtures("router")
def test_states_are_published_and_answered(bus: Bus, processes: Processes) -> None:
    seen: list[Status] = []
    alive: list[bool] = []
    bus.subscribe("swarm/r0/test/status", lambda key, payload: seen.append(decode(Status, payload, key)))
    bus.watch("swarm/r0/test/alive", lambda _, up: alive.append(up))
    assert bus.wait_connected(60)
    process = processes.start_ready("-c", SERVICE)
    answers: list[Status] = []

    def state() -> str:
        bus.ask("swarm/r0/test/status", lambda k, p: answers.append(decode(Status, p, k)), timeout_s=0.5)
        return answers[-1].state if answers else ""

    wait_until(lambda: state() == "ready")
    assert answers[-1].pid == process.pid
    assert answers[-1].counters == {"dropped": 3}
    assert answers[-1].since <= answers[-1].t
    wait_until(lambda: alive == [True])
    tell(process, "degraded no peer")
    wait_until(lambda: seen and (seen[-1].state, seen[-1].reason) == ("degraded", "no peer"))
    wait_until(lambda: state() == "degraded")
    tell(process, "ready")
    wait_until(lambda: seen[-1].state == "ready")
    assert seen[-1].reason == ""
    assert stop(process) == 0
    wait_until(lambda: seen[-1].state == "stopping")
    wait_until(lambda: alive == [True, False])


@pytest.mark.usefixtures("router")
def test_a_state_reached_before_the_bus_was_there_is_told(bus: Bus, processes: Processes) -> None:
    """`ready()` comes within microseconds of the start, the connection to the bus later."""
    seen: list[str] = []
    bus.subscribe("swarm/r0/test/status", lambda key, payload: seen.append(decode(Status, payload, key).state))
    assert bus.wait_connected(60)
    for _ in range(3):
        seen.clear()
        process = processes.start_ready("-c", SERVICE)
        wait_until(lambda: "ready" in seen)
        assert stop(process) == 0
        wait_until(lambda: seen[-1] == "stopping")


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_signals_end_a_service_cleanly(processes: Processes, number: signal.Signals) -> None:
    process = processes.start_ready("-c", SERVICE)
    process.send_signal(number)
    _, errors = process.communicate(timeout=60)
    assert (process.returncode, errors) == (0, "")


def test_many_signals_at_once_do_not_lock_it_up(processes: Processes) -> None:
    busy = SERVICE.replace("service.stopping.wait()", "while not service.stopping.wait(0.0001): pass")
    for _ in range(5):
        process = processes.start_ready("-c", busy)
        for _ in range(50):
            process.send_signal(signal.SIGTERM)
        assert process.wait(60) == 0


def test_a_service_notifies_systemd_of_its_state(runtime: Path, processes: Processes) -> None:
    with systemd(runtime) as sock:
        process = processes.start("-c", SERVICE, NOTIFY_SOCKET=str(runtime / "systemd"))
        assert sock.recv(1024) == b"READY=1\nSTATUS=ready"
        tell(process, "degraded no peer")
        assert sock.recv(1024) == b"STATUS=degraded no peer"
        tell(process, "watchdog")
        assert sock.recv(1024) == b"WATCHDOG=1"
        tell(process, "stop")
        assert sock.recv(1024) == b"STOPPING=1\nSTATUS=stopping"
    assert process.wait(60) == 0


def test_systemds_watchdog_is_not_flooded(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each message makes a socket and wakes systemd; a service may get 2000 things done in a second."""
    told: list[float] = []
    now = 0.0
    monkeypatch.setattr(service.clock, "now", lambda: now)
    monkeypatch.setattr(service, "notify", lambda _, timeout_s: told.append(now))
    fed = SimpleNamespace(_fed_at=float("-inf"))
    for step in range(1000):
        now = step * 0.01
        service.Service.watchdog(fed)  # type: ignore[arg-type]
    assert told[0] == 0.0
    assert all(FEED_S <= b - a < 2 * FEED_S for a, b in pairwise(told))


def test_a_systemd_that_hangs_holds_up_nobody_who_feeds_the_watchdog(
    runtime: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """It held up the router's only thread, and whoever waited for the lock of an app, for a second each."""
    with systemd(runtime) as sock:
        monkeypatch.setenv("NOTIFY_SOCKET", sock.getsockname())
        waits: list[float] = []
        monkeypatch.setattr(socket.socket, "settimeout", lambda _, seconds: waits.append(seconds))
        service.Service.watchdog(SimpleNamespace(_fed_at=float("-inf")))  # type: ignore[arg-type]
    assert waits == [0.0]
    assert not caplog.records


def test_systemd_is_notified_over_an_abstract_socket(monkeypatch: pytest.MonkeyPatch) -> None:
    name = f"swarm-test-{os.getpid()}"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sock:
        sock.bind("\0" + name)
        sock.settimeout(60)
        monkeypatch.setenv("NOTIFY_SOCKET", "@" + name)
        notify("READY=1")
        assert sock.recv(100) == b"READY=1"


def test_a_missing_systemd_is_only_logged(
    runtime: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setenv("NOTIFY_SOCKET", str(runtime / "nobody"))
    notify("READY=1")
    assert "systemd was not notified" in caplog.text


PARENT = """
import os, subprocess, sys
child = subprocess.Popen([sys.executable, "-c", sys.argv[1]], stdin=subprocess.PIPE, env=os.environ | {
    "SWARM_PARENT": str(os.getpid()), "NOTIFY_SOCKET": sys.argv[2]})
print(child.pid, flush=True)
child.wait()
"""


@pytest.mark.parametrize("stopped", [False, True], ids=["running", "stopped"])
def test_a_service_dies_with_its_parent(runtime: Path, processes: Processes, *, stopped: bool) -> None:
    with systemd(runtime) as sock:
        parent = processes.start("-c", PARENT, SERVICE, str(runtime / "systemd"))
        assert parent.stdout is not None
        pid = int(parent.stdout.readline())
        assert b"READY=1" in sock.recv(1024)
    if stopped:
        os.kill(pid, signal.SIGSTOP)
    parent.kill()
    parent.wait()
    wait_until(lambda: not is_running(pid))


def is_running(pid: int) -> bool:
    """Whether the process still does something: an orphan may stay a zombie where nobody reaps it."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


def test_a_service_does_not_start_when_its_parent_is_gone_already(processes: Processes) -> None:
    process = processes.start("-c", SERVICE, SWARM_PARENT="1")
    assert process.wait(60) == 1


def refused(processes: Processes, **environment: str) -> str:
    """The one line with which a service refuses to start."""
    process = processes.start("-c", SERVICE, **environment)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 2
    assert errors.count("\n") == 1
    assert "Traceback" not in errors
    return errors


def test_bad_input_is_one_line_and_exit_code_2(processes: Processes, runtime: Path) -> None:
    assert "swarm.toml" in refused(processes, SWARM_CONFIG=str(runtime / "missing" / "swarm.toml"))
    assert "r9" in refused(processes, SWARM_ROBOT="r9")
    assert "at most 107" in refused(processes, SWARM_RUNTIME="/tmp/" + "x" * 120)
    assert "SWARM_PARENT" in refused(processes, SWARM_PARENT="nobody")
    processes.config.write_text("network = \n")
    assert str(processes.config) in refused(processes)


def test_counters_grow_while_the_status_is_read(monkeypatch: pytest.MonkeyPatch, processes: Processes) -> None:
    """Threads count new names while the status is read."""
    for name, value in processes.environment().items():
        monkeypatch.setenv(name, value)
    code = """
import threading
from swarm.process.service import Service
with Service("test") as service:
    def count():
        for number in range(200_000):
            service.counters[f"n{number % 5000}"] += 1
            if number % 5000 == 4999:
                service.counters.clear()
    thread = threading.Thread(target=count)
    thread.start()
    while thread.is_alive():
        service.status()
"""
    subprocess.run([sys.executable, "-c", code], check=True, timeout=30)


@pytest.fixture
def root_logger() -> Iterator[logging.Logger]:
    root = logging.getLogger()
    handlers, level, raising = root.handlers[:], root.level, logging.raiseExceptions
    yield root
    root.handlers[:], logging.raiseExceptions = handlers, raising
    logging.getLogger("matplotlib").setLevel(logging.NOTSET)
    root.setLevel(level)


@pytest.mark.usefixtures("root_logger")
def test_the_journal_gets_a_priority_on_each_line(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    with (tmp_path / "journal").open("w+") as stream:
        monkeypatch.setattr(sys, "stderr", stream)
        status = os.fstat(stream.fileno())
        monkeypatch.setenv("JOURNAL_STREAM", f"{status.st_dev}:{status.st_ino}")
        log.setup("mesh").warning("stopped reason=%s", "x\n<3>mesh: forged")
        try:
            raise ValueError("first\nsecond")  # noqa: TRY301 - a traceback is wanted
        except ValueError:
            log.setup("mesh").exception("failed")
        monkeypatch.setenv("JOURNAL_STREAM", "1:1")
        log.setup("mesh").error("not the journal")
        stream.seek(0)
        lines = stream.read().splitlines()
    assert lines[:2] == ["<4>mesh: stopped reason=x\\n<3>mesh: forged", "<3>mesh: failed"]
    assert lines[-3:-1] == ["<3>| ValueError: first", "<3>| second"]
    assert lines[-1].endswith("ERROR   mesh: not the journal")


@pytest.mark.parametrize(("wanted", "level"), [("debug", 10), ("ERROR", 40), ("nonsense", 20), ("", 20)])
def test_the_environment_sets_the_level_of_the_log(
    root_logger: logging.Logger, monkeypatch: pytest.MonkeyPatch, wanted: str, level: int
) -> None:
    monkeypatch.setenv("SWARM_LOG", wanted)
    log.setup("mesh")
    assert root_logger.level == level
    assert not logging.getLogger("matplotlib.font_manager").isEnabledFor(logging.INFO)


def test_a_lost_stderr_does_not_matter(processes: Processes) -> None:
    """Whoever read the log went away: the service goes on and ends cleanly."""
    process = processes.start_ready("-c", SERVICE)
    assert process.stderr is not None
    process.stderr.close()
    tell(process, "degraded somebody hears that?")
    assert stop(process) == 0


def test_no_thread_is_left(processes: Processes, runtime: Path) -> None:
    router = processes.router()
    before = threading.active_count()
    with Bus.of(runtime) as bus:
        assert bus.wait_connected(60)
        bus.subscribe("swarm/**", lambda *_: None)
    # A thread of Zenoh's that has called back stays known to Python, as a dummy.
    wait_until(lambda: sum(not thread.name.startswith("Dummy") for thread in threading.enumerate()) <= before)
    assert stop(router) == 0


@pytest.mark.parametrize("service", ["apps", "balancer", "bus", "dwm", "mesh"])
def test_a_service_tells_what_it_is_by_help_and_refuses_unknown_arguments(processes: Processes, service: str) -> None:
    def run(argument: str) -> tuple[int | None, str, str]:
        process = processes.start("-m", f"services.{service}", argument)
        told, error = process.communicate(timeout=60)
        return process.returncode, told, error

    code, told, _ = run("--help")
    assert code == 0
    assert told.startswith(f"usage: python -m services.{service}")
    code, _, error = run("--wrong")
    assert (code, "error:" in error) == (2, True)
