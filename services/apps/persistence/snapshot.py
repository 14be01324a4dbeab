"""The newest snapshots of an app, kept through kill -9 (rule R5) at the price of one small write an iteration.

The file holds the last few snapshots, since a change of epoch may go back to an earlier one. It outlives the process,
not the machine, so nothing waits for a disk.
"""

from pathlib import Path

from services.apps.persistence.slots import SlotFile
from swarm.core.lockstep.frames import Snapshot
from swarm.errors import AppError

_SLOT = 64 * 1024
MAX_SNAPSHOT = SlotFile.most(_SLOT)
"""Largest snapshot, bytes: states take at most 440 each, so nearly all of it is the app's private fields'."""


class SnapshotFile(SlotFile):
    """The file `RUNTIME/app.<name>.snapshot`."""

    def __init__(self, path: Path, slots: int = 2) -> None:
        """Raises `LocalError` where the file cannot be made."""
        super().__init__(path, slots, _SLOT)

    def write(self, data: bytes) -> None:
        """Keep `data` in place of the oldest snapshot. Raises `LocalError` where that is impossible."""
        if len(data) > MAX_SNAPSHOT:
            raise AppError(
                f"a snapshot of {len(data)} bytes, at most {MAX_SNAPSHOT} can be kept: the private state and the "
                "values of all neighbours are too large"
            )
        super().write(data)

    def keep(self, snapshot: Snapshot) -> None:
        """Keep a snapshot in place of the oldest. Raises `SwarmError` where that is impossible."""
        self.write(snapshot.encode())
