"""The storage of data that outlives an app's process: on a robot in files, under virtual time in memory."""

from pathlib import Path
from typing import Protocol

from services.apps.persistence.ballots import BallotFile
from services.apps.persistence.snapshot import SnapshotFile
from swarm.core.epochs.notes import SavedEpochs
from swarm.core.lockstep.frames import Snapshot


class Snapshots(Protocol):
    """The newest snapshots of a lockstep. They outlive the process."""

    def read(self) -> list[bytes]:
        """Return the snapshots that were kept, the newest last."""

    def keep(self, snapshot: Snapshot) -> None:
        """Keep this in place of the oldest. Raises `SwarmError` where that is impossible."""

    def close(self) -> None:
        """Leave them to the next process."""


class Votes(Protocol):
    """The votes of a robot. They outlive a reboot."""

    lost: bool
    """Whether what was kept is damaged, once it was read."""

    def read(self) -> SavedEpochs | None:
        """Return the votes that were kept last."""

    def write(self, kept: SavedEpochs) -> None:
        """Keep this instead. Raises `SwarmError` where that is impossible."""

    def close(self) -> None:
        """Leave it to the next process."""


class Storage(Protocol):
    """The storage of one robot."""

    def snapshots(self, name: str, count: int) -> Snapshots:
        """Return the snapshots of a lockstep, at most `count`."""

    def votes(self, name: str) -> Votes:
        """Return the votes of a lockstep."""

    def parameters(self, app: str) -> Path | None:
        """Return the file for parameters that were changed while the app ran; None where they need not be kept."""


class FileStorage:
    """Files in the directory of the running services; votes are on the disk."""

    def __init__(self, runtime: Path) -> None:
        self._runtime = runtime

    def snapshots(self, name: str, count: int) -> SnapshotFile:
        """See `Storage`. Raises `LocalError` where the file cannot be made."""
        return SnapshotFile(self._runtime / f"app.{name}.snapshot", count)

    def votes(self, name: str) -> BallotFile:
        """See `Storage`. Raises `LocalError` where the file cannot be made."""
        return BallotFile(name)

    def parameters(self, app: str) -> Path:
        return self._runtime / f"app.{app}.parameters"
