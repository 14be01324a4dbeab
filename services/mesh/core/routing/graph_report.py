"""What one robot knows of all the others, for `mesh/graph`: members, their links, and who says that it is stopped.

Each robot floods its `mesh/stopped` as a latest value when it changes. So whoever stops the swarm sees on any robot's
bus who has obeyed. A value counts for the incarnation that has told it.
"""

from collections.abc import Callable, Sequence

from services.mesh.core.routing.link_state import LinkState
from services.mesh.core.routing.membership import Membership
from swarm.messages import GraphRobot, MeshGraph, Stopped
from swarm.messages.codec import decode

PAGE = 100
"""Robots in one answer at most."""

PAGE_LINKS = 1600
"""Links in one answer, where it has more than one robot. With this many a full page takes half of the 64 KiB that a
message on the bus may have; a robot may claim a link with each of 255 others."""


class Survey:
    """Puts together what the parts of the overlays know."""

    def __init__(
        self,
        me: str,
        names: Sequence[str],
        membership: Membership,
        links: LinkState,
        incarnation: Callable[[str], int],
    ) -> None:
        """`names` of all robots, sorted; `incarnation(robot)` is the newest one heard of."""
        self._me = me
        self._names = names
        self._membership = membership
        self._links = links
        self._incarnation = incarnation
        self._stopped: dict[str, tuple[int, bool]] = {}

    def heard(self, origin: str, incarnation: int, key: str, payload: bytes) -> None:
        """Another robot's `mesh/stopped`; raises `PayloadError`."""
        self._stopped[origin] = incarnation, decode(Stopped, payload, key).stopped

    def graph(self, now: float, *, stopped: bool, after: str = "") -> MeshGraph:
        """Robots with names behind `after`; `stopped` says whether this one is."""
        names = [name for name in self._names if name > after]
        page: list[GraphRobot] = []
        links = 0
        for name in names[:PAGE]:
            robot = self._robot(name, stopped)
            links += len(robot.links)
            if page and links > PAGE_LINKS:
                break
            page.append(robot)
        return MeshGraph(now, tuple(page), len(names) > len(page))

    def _robot(self, name: str, stopped: bool) -> GraphRobot:
        links = {peer: time * 1e-4 for peer, time in sorted(self._links.links(name).items())}
        if name == self._me:
            return GraphRobot(name, "self", 0.0, 0, None, links, stopped)
        member = self._membership.member(name)
        incarnation, told = self._stopped.get(name, (0, False))
        current = incarnation == self._incarnation(name) and incarnation != 0
        return GraphRobot(name, member.state, member.since, member.hops, member.via, links, told if current else None)
