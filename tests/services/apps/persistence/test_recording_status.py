"""What an app's status says of its recording."""

import logging
from collections import Counter
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from memory_swarm import config_of

from services.apps import loader
from services.apps.persistence.recording import AppRecording
from swarm.recording.recorded_topics import MAX_WAITING


class FakeService:
    """The part of `Service` that keeps the state."""

    def __init__(self) -> None:
        self.state, self.reason = "starting", ""

    def status(self) -> Any:
        return SimpleNamespace(state=self.state, reason=self.reason)

    def ready(self) -> None:
        self.state, self.reason = "ready", ""

    def degraded(self, reason: str) -> None:
        self.state, self.reason = "degraded", reason


def recording(service: FakeService) -> Any:
    it: Any = AppRecording.__new__(AppRecording)
    it._service, it._told = service, ""
    return it


FULL = "nothing is recorded: the disk is full; the run goes on"


def test_a_recording_that_has_ended_is_named_until_it_goes_on() -> None:
    service = FakeService()
    it = recording(service)
    it._tell("the disk is full")
    assert service.state == "starting"  # what keeps the app from its start is told first
    service.ready()
    it._tell("the disk is full")
    assert (service.state, service.reason) == ("degraded", FULL)
    it._tell("")
    assert service.state == "ready"


def test_a_fault_of_the_app_is_not_hidden_by_its_recording() -> None:
    service = FakeService()
    it = recording(service)
    service.ready()
    it._tell("the disk is full")
    service.degraded("the app raised")
    it._tell("the disk is full")
    it._tell("")
    assert (service.state, service.reason) == ("degraded", "the app raised")


def test_messages_of_services_that_are_lost_are_counted(tmp_path: Path) -> None:
    callbacks: list[Any] = []
    bus = SimpleNamespace(subscribe=lambda keys, callback: callbacks.append(callback))
    config = replace(config_of(2), path=tmp_path / "swarm.toml")
    config.path.touch()
    service: Any = SimpleNamespace(
        robot="r0", runtime=tmp_path, config=config, bus=bus, counters=Counter(), log=logging.getLogger("test")
    )
    it = AppRecording(service, loader.load("consensus"), 7, 1, tmp_path / "run")
    it._file.feed = lambda: None  # nothing is taken out meanwhile
    for _ in range(MAX_WAITING + 3):
        callbacks[0]("swarm/r0/balancer/leds", b"")
    it.close()
    assert service.counters == {"records_lost": 3}
