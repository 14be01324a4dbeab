"""An error that nobody expected ends a service with a reason in its log: no process stays behind without its thread."""

import subprocess
from pathlib import Path

import pytest
from conftest import Processes, ask, wait_until

from swarm.bus.zenoh_bus import Bus
from swarm.messages import Status, Stop
from swarm.messages.codec import decode
from swarm.process.edges import DEFECT

MESH = """
import resource
from services.mesh import __main__ as mesh
from services.mesh.core.node import MeshNode
from swarm.process import service

def broken(*arguments):
    {fault}

MeshNode.{method} = broken
service.run(mesh.main)
"""

APP = """
from services.apps.__main__ import main
from services.apps.core.lockstep_run import LockstepRun
from swarm.process.service import run

def broken(*arguments):
    raise KeyError("injected")

LockstepRun.{method} = broken
run(main)
"""

DEAF = """
import threading
from services.mesh import __main__ as mesh
from services.mesh.bus_interface import BusInterface
from swarm.process import service

def hang(*_):
    mesh._LOOK_S = 0.05
    threading.Event().wait()

BusInterface._stop = hang
service.run(mesh.main)
"""
"""A mesh that a stop makes deaf: Zenoh's thread hangs in its callback. From then on it asks the router often."""

HUGE = "resource.setrlimit(resource.RLIMIT_AS, (1 << 30, 1 << 30)); return bytes(1 << 40)"

SERVICE = """
import sys, threading
from swarm.errors import PayloadError
from swarm.process.service import Service, run

def main():
    with Service("test") as service:
        def heard(key, payload):
            if payload == b"wrong":
                raise PayloadError("a sample that is none")
            if payload == b"late":
                service.stop()
                raise KeyError("while it stops")
            if payload == b"defect":
                raise KeyError("a core left half changed")
        service.bus.subscribe("swarm/r0/test/set/x", heard)
        service.ready()
        {main}

run(main)
"""
WAIT = "service.stopping.wait()"


def ended(process: subprocess.Popen[str]) -> tuple[int, str]:
    _, text = process.communicate(timeout=60)
    return process.returncode, text


@pytest.mark.usefixtures("router")
@pytest.mark.parametrize(
    ("method", "fault", "reason"),
    [
        ("handle_timer", "raise KeyError('injected')", "KeyError('injected')"),
        ("handle_timer", HUGE, "MemoryError()"),
    ],
)
def test_a_mesh_whose_reading_thread_dies_ends_with_the_reason(
    processes: Processes, method: str, fault: str, reason: str
) -> None:
    """It stayed, answered nobody, and fed no link, until the watchdog found out."""
    code, text = ended(processes.start("-c", MESH.format(method=method, fault=fault)))
    assert code == DEFECT
    assert f"ended by a defect in the thread 'mesh': {reason}" in text
    assert "in broken" in text, "the traceback is there"


@pytest.mark.usefixtures("router")
def test_a_mesh_whose_bus_thread_hangs_ends(processes: Processes, runtime: Path) -> None:
    """It stayed, and the watchdog was fed: no stop of this robot reached others, and none of theirs this robot."""
    mesh = processes.start_ready("-c", DEAF)
    with Bus.of(runtime) as bus:

        def is_over() -> bool:
            bus.publish("swarm/stop", Stop(0.0, "test", "hang"))
            return mesh.poll() is not None

        wait_until(is_over, what="the end of the deaf mesh")
    code, text = ended(mesh)
    assert code == DEFECT
    assert "20 questions to the router were not answered" in text


@pytest.mark.usefixtures("router")
@pytest.mark.parametrize(("method", "thread"), [("handle_timer", "timers"), ("begin", "steps")])
def test_an_app_host_whose_core_fails_ends_with_the_reason(processes: Processes, method: str, thread: str) -> None:
    """It stayed as a fault of its app for good; started anew it goes on from its snapshot."""
    processes.start_ready("-m", "services.mesh")
    code, text = ended(processes.start("-c", APP.format(method=method), "consensus"))
    assert code == DEFECT
    assert f"ended by a defect in the thread '{thread}': KeyError('injected')" in text


@pytest.mark.usefixtures("router")
def test_a_defect_in_a_bus_callback_ends_the_service_and_a_wrong_sample_does_not(
    processes: Processes,
) -> None:
    process = processes.start_ready("-c", SERVICE.format(main=WAIT))
    with Bus.of(processes.runtime) as bus:
        assert bus.wait_connected(60)
        wait_until(lambda: bus.wanted("swarm/r0/test/set/x"))

        def dropped() -> int:
            bus.publish("swarm/r0/test/set/x", b"wrong")
            return decode(Status, ask(bus, "swarm/r0/test/status"), "").counters.get("dropped_samples", 0)

        wait_until(lambda: dropped() >= 3)
        assert process.poll() is None

        def gone() -> bool:
            bus.publish("swarm/r0/test/set/x", b"defect")
            return process.poll() is not None

        wait_until(gone)
    code, text = ended(process)
    assert code == DEFECT
    assert "ended by a defect in a bus callback: KeyError('a core left half changed')" in text
    assert "in heard" in text


@pytest.mark.usefixtures("router")
def test_what_fails_while_a_service_stops_is_logged_and_does_not_change_its_end(processes: Processes) -> None:
    process = processes.start_ready("-c", SERVICE.format(main=WAIT))
    with Bus.of(processes.runtime) as bus:
        assert bus.wait_connected(60)

        def gone() -> bool:
            bus.publish("swarm/r0/test/set/x", b"late")
            return process.poll() is not None

        wait_until(gone)
    code, text = ended(process)
    assert code == 0
    assert "KeyError('while it stops')" in text


@pytest.mark.usefixtures("router")
@pytest.mark.parametrize(
    ("statement", "code", "reason"),
    [
        ("raise KeyError('injected')", DEFECT, "ended by a defect in the main thread: KeyError('injected')"),
        ("raise PayloadError('one line')", DEFECT, "ended by a defect in the main thread: PayloadError('one line')"),
    ],
)
def test_a_main_thread_that_ends_by_an_error_does_not_wait_for_other_threads(
    processes: Processes, statement: str, code: int, reason: str
) -> None:
    main = f"threading.Thread(target=threading.Event().wait).start(); {statement}"
    found, text = ended(processes.start("-c", SERVICE.format(main=main)))
    assert found == code
    assert reason in text


@pytest.mark.usefixtures("router")
def test_one_of_our_errors_before_a_service_is_ready_is_one_line_and_no_reason_to_start_it_anew(
    processes: Processes,
) -> None:
    service = SERVICE.replace("service.ready()", "raise PayloadError('one line')")
    code, text = ended(processes.start("-c", service.format(main=WAIT)))
    assert (code, text.strip().splitlines()[-1]) == (2, "-c: one line")
