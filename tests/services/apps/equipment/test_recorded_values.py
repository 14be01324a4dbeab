"""What an app records is told to whoever watches, too."""

from typing import Any

from services.apps.equipment.recorded_values import MAX_NAMES, RecordedValues
from swarm.messages import AppOutput


class Bus:
    """Keeps what is published."""

    def __init__(self) -> None:
        self.published: list[tuple[str, AppOutput]] = []

    def publish(self, name: str, message: Any, *, urgent: bool = False) -> None:
        assert not urgent
        self.published.append((name, message))


def test_each_value_is_recorded_and_ten_a_second_of_a_name_are_published() -> None:
    bus, kept = Bus(), list[tuple[str, float, Any]]()
    record = RecordedValues(bus, "r0", "mine", lambda *row: kept.append(row))  # type: ignore[arg-type]
    for step in range(100):
        record("off", step / 100, float(step))
    record("Distance_to_the_target", 0.5, "text")
    assert len(kept) == 101
    told = [message for name, message in bus.published if name == "swarm/r0/app/mine/record/off"]
    assert 9 <= len(told) <= 10
    assert told[0] == AppOutput(0.0, {"value": 0.0})
    assert bus.published[-1] == ("swarm/r0/app/mine/record/Distance_to_the_target", AppOutput(0.5, {"value": "text"}))


def test_without_a_recording_and_with_names_without_end_it_goes_on() -> None:
    bus = Bus()
    record = RecordedValues(bus, "r0", "mine", None)  # type: ignore[arg-type]
    for number in range(2 * MAX_NAMES):
        record(f"n{number}", 0.0, number)
    assert len(bus.published) == MAX_NAMES
