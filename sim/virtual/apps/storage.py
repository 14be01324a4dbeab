"""The storage of a virtual robot's apps: votes outlive a reboot, snapshots the end of a process."""

from collections import deque

from swarm.core.epochs.notes import SavedEpochs
from swarm.core.lockstep.frames import Snapshot


class MemorySnapshots:
    """Snapshots in memory; see `services.apps.persistence.storage.Snapshots`."""

    def __init__(self, count: int) -> None:
        """`count`: how many are kept; 0 where nobody would read one."""
        self._kept: deque[bytes] = deque(maxlen=count)

    def read(self) -> list[bytes]:
        return list(self._kept)

    def keep(self, snapshot: Snapshot) -> None:
        if self._kept.maxlen:
            self._kept.append(snapshot.encode())

    def close(self) -> None:
        """See `Snapshots`."""


class MemoryVotes:
    """Votes in memory; see `services.apps.persistence.storage.Votes`."""

    lost = False

    def __init__(self) -> None:
        self._kept: SavedEpochs | None = None

    def read(self) -> SavedEpochs | None:
        return self._kept

    def write(self, kept: SavedEpochs) -> None:
        self._kept = kept

    def close(self) -> None:
        """See `Votes`."""


class MemoryStorage:
    """The storage of one robot; see `services.apps.persistence.storage.Storage`."""

    def __init__(self, *, snapshots: bool = False) -> None:
        """`snapshots`: whether a process may end, so that the next one wants them. A robot that is switched off loses
        them."""
        self._votes: dict[str, MemoryVotes] = {}
        self._keeps = snapshots
        self._snapshots: dict[str, MemorySnapshots] = {}

    def snapshots(self, name: str, count: int) -> MemorySnapshots:
        return self._snapshots.setdefault(name, MemorySnapshots(count if self._keeps else 0))

    def forget(self) -> None:
        """Forget the snapshots, as when the robot is switched off."""
        self._snapshots.clear()

    def votes(self, name: str) -> MemoryVotes:
        return self._votes.setdefault(name, MemoryVotes())

    @staticmethod
    def parameters(app: str) -> None:
        """See `Storage`: a robot that is switched off forgets what was changed."""
