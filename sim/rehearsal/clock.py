"""The swarm's common time and the ranges to other robots in a rehearsal: perfect, and none."""

from collections.abc import Callable

from swarm.messages import Range


class CommonClock:
    """In place of `swarm.app.mesh_clock.MeshClock`: all robots have the very same time."""

    error = 0.0

    def __init__(self, root: str, now: Callable[[], float]) -> None:
        """`root`: whose clock it is; `now`: the time of the rehearsal, s."""
        self.root = root
        self.now = now

    def monotonic(self, mesh: float) -> float:
        """When it will be that time by the robot's own clock."""
        return mesh


class NoRanges:
    """In place of `swarm.app.ranging.Ranging`: no module measures anything."""

    ranges: tuple[Range, ...] = ()

    def distance(self, robot: str) -> float | None:
        """See `Ranging`."""
        return None
