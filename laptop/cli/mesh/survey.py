"""What the meshes know of the whole swarm, asked of those whose buses can be reached (`mesh/graph`)."""

import contextlib
import threading
from collections.abc import Iterator, Mapping
from pathlib import Path

from swarm.bus.zenoh_bus import Bus
from swarm.errors import LocalError, PayloadError
from swarm.messages import GraphRobot, MeshGraph
from swarm.messages.codec import decode
from swarm.messages.keys import is_name, key

PATIENCE = 3.0
"""s to wait for a bus that is not there yet."""

AWAY = ("left", "gone", "never")


class MeshViews:
    """The newest answer of each mesh that was asked: who asks calls `ask`, then looks at `robots` when it likes."""

    def __init__(self) -> None:
        self.robots: dict[str, dict[str, GraphRobot]] = {}
        """By the robot that was asked, and the robot it tells of."""
        self.changed = threading.Condition()

    def ask(self, name: str, bus: Bus, timeout_s: float) -> None:
        """Ask one robot's mesh; where it does not answer nothing happens."""
        self._page(name, bus, timeout_s, "", {})

    def _page(self, name: str, bus: Bus, timeout_s: float, after: str, found: dict[str, GraphRobot]) -> None:
        def take(text: str, payload: bytes) -> None:
            with contextlib.suppress(PayloadError):
                graph = decode(MeshGraph, payload, text)
                found.update((each.robot, each) for each in graph.robots if is_name(each.robot))
                if graph.more and graph.robots and graph.robots[-1].robot > after:  # or it would never end
                    self._page(name, bus, timeout_s, graph.robots[-1].robot, found)
                    return
                with self.changed:
                    self.robots[name] = found
                    self.changed.notify_all()

        bus.ask(key(name, "mesh", "graph"), take, timeout_s=timeout_s, **({"after": after} if after else {}))

    def best(self) -> dict[str, GraphRobot]:
        """One entry for each robot: its own word where it was asked, else that of one who has a way to it."""
        found: dict[str, GraphRobot] = {}
        with self.changed:
            views = {name: dict(view) for name, view in self.robots.items()}
        for view in views.values():
            for name, entry in view.items():
                known = found.get(name)
                if known is None or _rank(entry) < _rank(known):
                    found[name] = entry
        return dict(sorted(found.items()))


@contextlib.contextmanager
def opened(directories: Mapping[str, Path]) -> Iterator[dict[str, Bus]]:
    """The buses of these robots, those that are there; `LocalError` where none is."""
    with contextlib.ExitStack() as stack:
        # All are opened at once, so that several which are not there cost the patience for one.
        buses = {name: stack.enter_context(Bus.of(directory)) for name, directory in directories.items()}
        some = threading.Event()
        for bus in buses.values():
            bus.on_change(lambda up: some.set() if up else None)
        if not some.wait(PATIENCE):
            raise LocalError(f"no bus is there: {', '.join(map(str, directories.values()))}; is the robot switched on?")
        yield buses


def _rank(entry: GraphRobot) -> int:
    """The lower, the better it is known."""
    return 0 if entry.state == "self" else 1 if entry.state == "here" else 2
