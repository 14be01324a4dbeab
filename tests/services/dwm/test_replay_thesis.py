"""The longest recording of the thesis, test_5 with 2009 rows, replayed as fast as it is asked for: the dwm service
survives that, and nothing that it or a swarm on it says is larger than the bus takes."""

import threading
from collections.abc import Callable

import pytest
from conftest import CONFIG, Processes, ask, stop, wait_until
from thesis_data import DATA, needs_localization

from services.dwm.replay import _Row
from sim.virtual.run import run_virtually
from swarm.bus.packer import TOO_LARGE
from swarm.bus.zenoh_bus import Bus
from swarm.messages import Measurement, Status
from swarm.messages.codec import MAX_PAYLOAD, decode, encode
from swarm.recording.thesis_ranges import read_folder

TEST_5 = DATA / "localization" / "test_5"
ROWS = 2009
UNANSWERED = 64
"""Questions that are under way at once: as many as the bus takes without losing one."""

pytestmark = needs_localization


class Sizes:
    """The largest payload of each key."""

    def __init__(self) -> None:
        self.most: dict[str, int] = {}
        self.count = 0

    def take(self, key: str, payload: bytes) -> None:
        self.most[key] = max(self.most.get(key, 0), len(payload))
        self.count += 1


@pytest.mark.usefixtures("router")
def test_the_dwm_service_survives_all_of_test_5_at_once(
    processes: Processes, record_property: Callable[[str, object], None]
) -> None:
    processes.config.write_text(CONFIG + f'[dwm]\nsource = "replay:{TEST_5}"\ntarget = "C933"\n')
    found: dict[int, bytes] = {}
    free = threading.Semaphore(UNANSWERED)
    said = Sizes()

    def answered(_: str, payload: bytes) -> None:
        found[decode(Measurement, payload, "answer").sequence] = payload
        free.release()

    with Bus.of(processes.runtime) as bus:
        assert bus.wait_connected(60)
        bus.subscribe("swarm/**", said.take)
        process = processes.start_ready("-m", "services.dwm")
        ask(bus, "swarm/r0/dwm/measurement", sequence=0)
        for k in range(ROWS):
            assert free.acquire(timeout=60), f"row {k}: no answer to {UNANSWERED} rows before it"
            bus.ask("swarm/r0/dwm/measurement", answered, timeout_s=60.0, sequence=k)
        wait_until(lambda: len(found) == ROWS, what="answers to all rows")
        wait_until(lambda: said.count >= ROWS, what="the rows published")
        status = decode(Status, ask(bus, "swarm/r0/dwm/status"), "status")
    assert process.poll() is None
    assert (status.state, status.counters.get(TOO_LARGE, 0)) == ("ready", 0)
    assert stop(process) == 0
    assert max(said.most.values()) <= MAX_PAYLOAD
    record_property("measured", f"heard {said.count} messages, the largest of {max(said.most.values())} bytes")


def test_no_row_of_test_5_makes_a_message_that_is_too_large() -> None:
    for recording in read_folder(TEST_5):
        for k in range(recording.steps):
            row = _Row(recording, k)
            for message in (row.measurement(), *row.published("C933", 1e9)):
                assert len(encode(message)) < 200


@pytest.mark.slow
def test_no_telemetry_of_a_swarm_on_test_5_is_too_large(caplog: pytest.LogCaptureFixture) -> None:
    words = ("--algorithm", "thesis", "--step-size", "5e-7", "--latency", "0ms")
    report, outcome = run_virtually("localization", "--replay", str(TEST_5), *words)
    assert report["problems"] == []
    assert outcome.scenario.iterations == report["iterations"] == ROWS
    assert [record.message for record in caplog.records if "the bus takes at most" in record.message] == []
