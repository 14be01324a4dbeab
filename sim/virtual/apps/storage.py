"""The storage of a virtual robot's apps: votes outlive a reboot, snapshots the end of a process."""

from collections import deque

from swarm.core.epochs.notes import SavedEpochs
from swarm.core.lockstep.frames import Snapshot


class NoSnapshots:
    """Snapshots that are not kept, since nobody would read them: no process ends, and robots that are switched off
    lose theirs."""

    @staticmethod
    def read() -> list[bytes]:
        return []

    @staticmethod
    def keep(snapshot: Snapshot) -> None:
        """Keep nothing."""

    @staticmethod
    def close() -> None:
        """See `Snapshots`."""


class MemorySnapshots:
    """Snapshots in memory; see `services.apps.persistence.storage.Snapshots`."""

    def __init__(self, count: int) -> None:
        self._kept: deque[bytes] = deque(maxlen=count)

    def read(self) -> list[bytes]:
        return list(self._kept)

    def keep(self, snapshot: Snapshot) -> None:
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
        """`snapshots`: whether a process may end, so that the next one wants them."""
        self._votes: dict[str, MemoryVotes] = {}
        self._snapshots: dict[str, MemorySnapshots] | None = {} if snapshots else None

    def snapshots(self, name: str, count: int) -> MemorySnapshots | NoSnapshots:
        if self._snapshots is None:
            return NoSnapshots()
        return self._snapshots.setdefault(name, MemorySnapshots(count))

    def forget(self) -> None:
        """Forget the snapshots, as when the robot is switched off."""
        if self._snapshots is not None:
            self._snapshots.clear()

    def votes(self, name: str) -> MemoryVotes:
        return self._votes.setdefault(name, MemoryVotes())

    @staticmethod
    def parameters(app: str) -> None:
        """See `Storage`: a robot that is switched off forgets what was changed."""
