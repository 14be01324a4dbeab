"""What an app's status says of its recording."""

from types import SimpleNamespace
from typing import Any

from services.apps.persistence.recording import AppRecording


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
