"""Two handshakes that end at once, of which only one finds a place for its link."""

from collections import Counter
from itertools import pairwise

from services.mesh.core.link.calls import Local
from services.mesh.core.link.clock import ClockSync
from services.mesh.core.link.session import Session
from services.mesh.core.node import MeshNode
from services.mesh.core.overlays.robot_overlays import RobotOverlays
from services.mesh.core.relay import KeyRelay
from services.mesh.core.routing.topology import Ground, TopologyVersion
from services.mesh.core.routing.wanted_links import InitialLinks

NAMES = [f"r{number}" for number in range(9)]
ROBOTS = frozenset(NAMES)
NOW = 100.0


class Call:
    """A call of r0 and the session at the other end."""

    def __init__(self, node: MeshNode, peer: str) -> None:
        local = Local(robot=peer, network="n", incarnation=2, insecure=True, dials={"r0": False}, robots=ROBOTS)
        self.node, self.near = node, node.dialled(peer, NOW)
        self.far = Session(
            local, b"y" * 16, NOW, dialled=None, expected="r0",
            admit=lambda *_: True, clock=ClockSync(peer, 2, ROBOTS), counters=Counter(),
        )  # fmt: skip

    def exchange(self) -> None:
        if data := self.far.data_to_send(NOW, 4096):
            self.node.connections.receive(self.near, data, NOW)
        if data := self.near.data_to_send(NOW, 4096):
            self.far.receive(data, NOW)
            self.far.events()


def test_a_wanted_robot_that_finds_no_place_stays_wanted_and_is_called_again() -> None:
    edges = [("r0", name) for name in NAMES[1:8]]
    ground = Ground(NAMES, list(pairwise(NAMES)), auto=True)
    saved = TopologyVersion(1, 1, "r0", True, (*edges, ("r1", "r8")))
    local = Local(
        robot="r0", network="n", incarnation=1, insecure=True, dials=dict.fromkeys(NAMES[1:], True), robots=ROBOTS
    )
    counters: Counter[str] = Counter()
    overlays = RobotOverlays(
        "r0", ROBOTS, incarnation=1, random=lambda: 0.5, counters=counters,
        start=InitialLinks(ground, local.dials, saved, False),
    )  # fmt: skip
    node = MeshNode(
        local, KeyRelay("r0", (), [], ROBOTS), overlays, random=lambda: 0.5, nonce=lambda: b"x" * 16, counters=counters
    )
    node.handle_timer(NOW)
    for name in (*NAMES[1:6], "r8"):  # r8 is no neighbour any more, and takes the sixth place
        call = Call(node, name)
        for _ in range(4):
            call.exchange()
    calls = [Call(node, name) for name in ("r6", "r7")]
    for _ in range(5):
        for call in calls:
            call.exchange()
    up = {name for name, link in node.connections.links.items() if link.session is not None}
    assert len(up & {"r6", "r7"}) == 1
    (waiting,) = {"r6", "r7"} - up
    assert node.connections.links[waiting].dialler is not None
