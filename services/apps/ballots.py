"""A robot's part in the agreement on epochs, kept through reboots: who has voted once must never vote otherwise.

Written a few times in a run, when the members change: whole and on the disk before anything of it is told.
"""

import os

from swarm.codec import decode, encode
from swarm.core.epoch_notes import Epoch, Kept
from swarm.errors import LocalError, PayloadError
from swarm.messages import AppEpoch
from swarm.paths import state_dir


class BallotFile:
    """`STATE/epochs/<app>`, of the newest run."""

    def __init__(self, app: str) -> None:
        """Raises `LocalError` where the folder cannot be made."""
        self._path = state_dir() / "epochs" / app
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise LocalError(f"{self._path.parent}: {error.strerror}") from None

    def read(self) -> Kept | None:
        """What was kept last; None where that is nothing, or is no such file."""
        try:
            return decode(Kept, self._path.read_bytes(), str(self._path))
        except (OSError, PayloadError):
            return None

    def write(self, kept: Kept) -> None:
        """Keep this instead. Raises `LocalError` where that is impossible."""
        new = self._path.with_name(f"{self._path.name}.new")
        try:
            with new.open("wb") as file:
                file.write(encode(kept))
                file.flush()
                os.fsync(file.fileno())
            new.replace(self._path)
        except OSError as error:
            raise LocalError(f"{self._path}: {error.strerror}") from None


def told(epoch: Epoch, now: float) -> AppEpoch:
    """What a host tells, and records, of the epoch it is in."""
    return AppEpoch(
        *(now, epoch.counter, epoch.k, epoch.members, epoch.edges, epoch.away, epoch.forced),
        epoch.number,
    )
