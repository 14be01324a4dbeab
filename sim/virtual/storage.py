"""What the apps of a virtual robot keep through a reboot: votes."""

from swarm.core.epoch_notes import SavedEpochs
from swarm.core.lockstep_frames import Snapshot


class NoSnapshots:
    """In place of snapshots that nobody would read: robots that are switched off lose theirs."""

    @staticmethod
    def read() -> list[bytes]:
        """See `Snapshots`."""
        return []

    @staticmethod
    def keep(snapshot: Snapshot) -> None:
        """See `Snapshots`."""

    @staticmethod
    def close() -> None:
        """See `Snapshots`."""


class MemoryVotes:
    """See `services.apps.storage.Votes`."""

    __slots__ = ("_kept",)

    lost = False

    def __init__(self) -> None:
        self._kept: SavedEpochs | None = None

    def read(self) -> SavedEpochs | None:
        """See `Votes`."""
        return self._kept

    def write(self, kept: SavedEpochs) -> None:
        """See `Votes`."""
        self._kept = kept

    def close(self) -> None:
        """See `Votes`."""


class MemoryStorage:
    """See `services.apps.storage.Storage`. Of one robot."""

    __slots__ = ("_votes",)

    def __init__(self) -> None:
        self._votes: dict[str, MemoryVotes] = {}

    @staticmethod
    def snapshots(name: str, count: int) -> NoSnapshots:
        """See `Storage`."""
        return NoSnapshots()

    def votes(self, name: str) -> MemoryVotes:
        """See `Storage`."""
        return self._votes.setdefault(name, MemoryVotes())

    @staticmethod
    def parameters(app: str) -> None:
        """See `Storage`: a robot that is switched off forgets what was changed."""
