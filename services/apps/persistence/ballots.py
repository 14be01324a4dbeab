"""A robot's part in the agreement on epochs, kept through reboots: a robot that has voted must never vote otherwise.

The file is written a few times in a run, when the members change, and is on the disk before anything of it is told.
Each vote is written twice, into two slots one after the other: a power cut tears one of them at most, and one slot that
the disk loses later takes nothing away. Where both are damaged the robot has lost its vote (`swarm.core.epochs`).
"""

from services.apps.persistence.slots import SlotFile
from swarm.core.epochs.notes import Epoch, SavedEpochs
from swarm.errors import LocalError, PayloadError
from swarm.files import atomic_write, make_folder
from swarm.messages import AppEpoch
from swarm.messages.codec import MAX_PAYLOAD, decode, encode
from swarm.process.paths import state_dir

_COPIES = 2
_ROOM = MAX_PAYLOAD + 4096


class BallotFile:
    """`STATE/epochs/<app>.votes`, of the newest run."""

    def __init__(self, app: str) -> None:
        """Raises `LocalError` where the file cannot be made, or is not this user's."""
        path = state_dir() / "epochs" / f"{app}.votes"
        try:
            make_folder(path.parent)
            if not path.exists():
                # Whole from the beginning: a file without a whole slot is a damaged one.
                atomic_write(path, SlotFile.fresh(_COPIES, _ROOM))
        except OSError as error:
            raise LocalError(f"{path}: {error.strerror}") from None
        self._slots = SlotFile(path, _COPIES, _ROOM)
        self._path = path
        self.lost = False
        """Whether the file was damaged when it was read: nobody knows any more what this robot has voted."""

    def read(self) -> SavedEpochs | None:
        """Return what was kept last; None where that is nothing, or is `lost`."""
        whole = self._slots.read()
        self.lost = not whole
        if not whole:
            return None
        if len(whole) < _COPIES or len(set(whole)) > 1:
            self._write(whole[-1])  # one copy was torn or has decayed since: what is gone on with is there twice
        try:
            return decode(SavedEpochs, whole[-1], str(self._path)) if whole[-1] else None
        except PayloadError:
            self.lost = True
            return None

    def write(self, kept: SavedEpochs) -> None:
        """Keep this instead, on the disk. Raises `LocalError` where that is impossible."""
        self._write(encode(kept))

    def _write(self, data: bytes) -> None:
        for _ in range(_COPIES):
            self._slots.write(data)
            self._slots.sync()

    def close(self) -> None:
        """Leave the file for the next process."""
        self._slots.close()


def told(epoch: Epoch, now: float) -> AppEpoch:
    """Return the message about an epoch that a host publishes and records."""
    return AppEpoch(
        *(now, epoch.counter, epoch.k, epoch.members, epoch.edges, epoch.away, epoch.forced),
        epoch.number,
    )
