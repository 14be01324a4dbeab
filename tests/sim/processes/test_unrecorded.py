"""A disk without room: a run that could not be recorded does not start, and does not end as if all were well."""

from pathlib import Path

import pytest

from sim.processes.monitor import Seen, unrecorded
from swarm.errors import LocalError
from swarm.messages import Status
from swarm.recording import file


def status(service: str, state: str, reason: str) -> Status:
    return Status(1.0, service, state, reason, 1, 0.0, {})


def test_an_app_that_records_nothing_is_a_problem_of_the_run() -> None:
    full = status("app/consensus", "degraded", f"{file.UNRECORDED}: the disk is full; the run goes on")
    fell = status("balancer", "degraded", "fell")
    seen = {"r0": Seen(status={"balancer": fell}), "r1": Seen(status={"balancer": fell, "app/consensus": full})}
    assert unrecorded(seen) == [f"r1 app/consensus: {full.reason}"]


def test_a_disk_without_room_is_named_before_the_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(file, "MIN_FREE", 0)
    file.check_room(tmp_path)
    monkeypatch.setattr(file, "MIN_FREE", 1 << 62)
    with pytest.raises(LocalError, match="MiB are free on its disk"):
        file.check_room(tmp_path)
