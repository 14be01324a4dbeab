"""In which order the processes of a run end."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from sim.processes.processes import Child, Processes


class FakeProcess:
    """Notes what it is told."""

    pid = 1

    def __init__(self, name: str, note: Callable[[str], None]) -> None:
        self._name, self._note = name, note

    def send_signal(self, number: int) -> None:
        self._note(f"{self._name} told")

    def wait(self, timeout: float | None = None) -> None:
        self._note(f"{self._name} gone")


def test_no_mesh_is_asked_to_end_before_all_apps_have_ended(tmp_path: Path) -> None:
    """Else an app still records that its links are down, as if they had failed."""
    notes: list[str] = []
    processes = Processes({})
    for robot in ("r0", "r1"):
        for service in ("bus", "mesh", "app/consensus", "app/led_sync"):
            process: Any = FakeProcess(f"{robot} {service}", notes.append)
            processes.children.append(Child(robot, service, [], {}, tmp_path, process))
    processes.stop()
    last_app = max(place for place, note in enumerate(notes) if "app/" in note)
    assert notes[last_app].endswith("gone")
    first_other = min(place for place, note in enumerate(notes) if "app/" not in note)
    assert last_app < first_other
    assert len({note for note in notes if note.endswith("gone")}) == len(processes.children)
