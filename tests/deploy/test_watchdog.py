"""What feeds systemd's watchdog: real progress of each service, as the units expect it."""

import contextlib
import queue
import signal
import socket
from pathlib import Path

import pytest
from conftest import Processes, wait_until

from swarm.bus.zenoh_bus import Bus

FED = "WATCHDOG=1"


@pytest.mark.parametrize("module", ["services.bus", "services.mesh"])
def test_a_service_that_works_feeds_the_watchdog(processes: Processes, module: str) -> None:
    if module != "services.bus":
        processes.router()
    process = processes.start_ready("-m", module, until=FED)
    process.send_signal(signal.SIGTERM)
    assert process.wait(60) == 0


def test_an_app_that_waits_for_its_neighbours_feeds_the_watchdog(processes: Processes) -> None:
    processes.router()
    processes.start_ready("-m", "services.mesh")  # which tells the app who its neighbours are
    process = processes.start_ready("-m", "services.apps", "consensus", until=FED)
    process.send_signal(signal.SIGTERM)
    assert process.wait(60) == 0


HUNG = """
import threading
from swarm import SyncApp
from swarm.process import threads

threads.HANG = 0.0

class Hung(SyncApp):
    value: float

    def step(self, neighbours):
        open("{begun}", "w").close()
        threading.Event().wait()
"""


def test_an_app_whose_step_hangs_does_not_feed_the_watchdog(processes: Processes, runtime: Path) -> None:
    (runtime / "hung.py").write_text(HUNG.format(begun=runtime / "begun"))
    (runtime / "alone.toml").write_text(
        'network = "test"\n[mesh]\ninsecure = true\n[topology]\nedges = []\n[[robots]]\nname = "r0"\n'
    )
    processes.router()
    processes.start_ready("-m", "services.mesh", SWARM_CONFIG=str(runtime / "alone.toml"))
    progress: queue.SimpleQueue[bytes] = queue.SimpleQueue()
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd, Bus.of(runtime) as bus:
        systemd.bind(str(runtime / "systemd"))
        systemd.setblocking(False)
        bus.subscribe("swarm/r0/app/hung/progress", lambda _, payload: progress.put(payload))
        processes.start(
            "-m", "services.apps", str(runtime / "hung.py"),
            SWARM_CONFIG=str(runtime / "alone.toml"), NOTIFY_SOCKET=str(runtime / "systemd"),
        )  # fmt: skip

        def heard() -> list[bytes]:
            messages = []
            with contextlib.suppress(BlockingIOError):
                while True:
                    messages.append(systemd.recv(4096))
            return messages

        wait_until((runtime / "begun").exists, what="the step has begun")
        while not progress.empty():
            progress.get()
        for _ in range(2):  # by the second, what it had to say when the step began is said
            progress.get(timeout=60)
        heard()
        for _ in range(2):
            progress.get(timeout=60)
        assert heard() == []
