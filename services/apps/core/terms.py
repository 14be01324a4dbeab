"""The input of a `LockstepRun`: the author's app between packed states, and the settings of the whole run."""

from collections.abc import Mapping
from typing import NamedTuple, Protocol

from swarm.app.run_options import AFTER
from swarm.core.graph import Graph
from swarm.core.lockstep.stopping import Rule
from swarm.frozen import frozen
from swarm.messages import Measurement
from swarm.messages.codec import Value


class Told(NamedTuple):
    """What an app tells of its state at one iteration, or after one event."""

    state: dict[str, Value]
    """The shared state by name."""
    result: Mapping[str, Value]
    """The author's result, with the errors by which the app is measured."""


class AppAnswer(NamedTuple):
    """What the author's code gave in one job of the worker."""

    own: bytes
    """The shared state, packed."""
    private: bytes
    told: Told
    content: bool = False
    """Whether the app might stop here."""


class Program(Protocol):
    """The author's app between packed states: `services.apps.runner.Runner`."""

    k: int

    @property
    def size(self) -> int:
        """Bytes of one packed state."""

    def start(self, measurement: Measurement | None) -> tuple[bytes, bytes]:
        """Return the first state, packed: shared, private."""

    def step(
        self, k: int, own: bytes, values: Mapping[str, bytes], measurement: Measurement | None
    ) -> tuple[bytes, bytes]:
        """x(k+1), packed: shared, private."""

    def restore(self, k: int, own: bytes, private: bytes, graph: Graph) -> None:
        """Be again where a snapshot was taken."""

    def renew(self, k: int, at: int, own: bytes, private: bytes, graph: Graph) -> tuple[bytes, bytes]:
        """Be at k with this state, which is that of iteration `at` of the epoch before, among these robots; the state
        the app goes on with, packed: shared, private."""

    def entered(self, k: int) -> None:
        """The robot is in the epoch of the last `renew`, at its first iteration k."""

    def told(self) -> Told:
        """Return what the app tells of the state at which it is."""

    def content(self) -> bool:
        """Return whether the last step has changed the state so little that the app might stop."""


@frozen
class Terms:
    """The settings of a whole run, the same on all robots."""

    run: int
    schema: int
    last: int | None = None
    """The last iteration, if there is one."""
    rule: Rule | None = None
    """Another reason to stop."""
    drop: bool = False
    """Whether absent robots are dropped, and admitted again when they return."""
    after: float = AFTER
    """Seconds without a message after which they are dropped."""

    @property
    def notes(self) -> str:
        """The chunk of the key under which notes about the members travel, beside the frames."""
        return f"{self.run:016x}-{self.schema:08x}-epochs"
