"""What the apps of a virtual robot keep: snapshots through the end of an app's process, votes through a reboot, too."""

from collections import deque

from swarm.core.epoch_notes import SavedEpochs
from swarm.core.lockstep_frames import Snapshot


class MemorySnapshots:
    """See `services.apps.storage.Snapshots`."""

    __slots__ = ("_kept",)

    def __init__(self, count: int) -> None:
        self._kept: deque[bytes] = deque(maxlen=count)

    def read(self) -> list[bytes]:
        """See `Snapshots`."""
        return list(self._kept)

    def keep(self, snapshot: Snapshot) -> None:
        """See `Snapshots`."""
        self._kept.append(snapshot.encode())

    def close(self) -> None:
        """See `Snapshots`."""


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

    __slots__ = ("_restarts", "_snapshots", "_votes")

    def __init__(self, *, restarts: bool = False) -> None:
        """`restarts`: whether an app may be started again without the robot, and finds its snapshots."""
        self._restarts = restarts
        self._snapshots: dict[str, MemorySnapshots] = {}
        self._votes: dict[str, MemoryVotes] = {}

    def snapshots(self, name: str, count: int) -> MemorySnapshots | NoSnapshots:
        """See `Storage`."""
        if not self._restarts:
            return NoSnapshots()
        return self._snapshots.setdefault(name, MemorySnapshots(count))

    def votes(self, name: str) -> MemoryVotes:
        """See `Storage`."""
        return self._votes.setdefault(name, MemoryVotes())

    @staticmethod
    def parameters(app: str) -> None:
        """See `Storage`: a robot that is switched off forgets what was changed."""
