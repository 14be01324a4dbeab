"""Two authenticated links of which one is watched while the other is attacked."""

from collections.abc import Callable, Iterator

import pytest
from mesh_world import End, World

from services.mesh.core.link.calls import LONGEST_DELAY
from services.mesh.core.wire import frames
from services.mesh.core.wire.frames import Hello
from swarm.config.types import MeshConfig

KEY_ID, SECRET = 7, bytes(range(32))
KEYS = {KEY_ID: SECRET}
LINE = [("r0", "r1"), ("r1", "r2")]
SYNC = "swarm/{}/app/consensus/sync/00000000000000a1-0-3-9f3c21aa"
HANDSHAKE_TIMEOUT = MeshConfig().handshake
RECOVERY = 3.0 + 1.5 * LONGEST_DELAY + HANDSHAKE_TIMEOUT + 1.0


def hello(**changes: object) -> bytes:
    """What r0, which dials r1, might say."""
    values: dict[str, object] = {
        "network": "lab",
        "robot": "r0",
        "incarnation": 0,  # it tells no process, so it is no second robot
        "nonce": bytes(16),
        "dialler": True,
        "insecure": False,
        "key_ids": (KEY_ID,),
    }
    return frames.encode_hello(Hello(**(values | changes)))  # type: ignore[arg-type]


class Watched:
    """r0 - r1 - r2, where r1 and r2 talk all the time: none of it may be lost, nor their link be made anew."""

    def __init__(self, keys: dict[int, bytes] | None = KEYS) -> None:
        self.world = World(LINE, keys=keys)
        self.streams: dict[str, list[tuple[End, bytes]]] = {"r0": [], "r1": []}
        self.changes: Callable[[End, bytes], bytes] | None = None
        self.world.tap = self._tap
        self.world.run(1.0)
        assert self.world.all_up()
        self._count = 0

    def _tap(self, end: End, data: bytes) -> bytes:
        if end.peer is None or {end.robot, end.peer.robot} != {"r0", "r1"}:
            return data
        self.streams[end.robot].append((end, data))
        return data if self.changes is None else self.changes(end, data)

    def run(self, seconds: float) -> None:
        """Let time pass while r1 and r2 talk."""
        steps = max(1, round(seconds / 0.1))
        for _ in range(steps):
            for sender in ("r1", "r2"):
                self.world.publish(sender, SYNC.format(sender), self._count.to_bytes(4, "big"))
            self._count += 1
            self.world.run(seconds / steps)

    def recorded(self, robot: str) -> list[bytes]:
        """What a robot has sent over the link of r0 and r1 since the start, write by write."""
        return [data for _, data in self.streams[robot]]

    def check_others(self) -> None:
        """The link of r1 and r2 has lost nothing."""
        self.world.run(0.1)
        for sender, receiver in (("r1", "r2"), ("r2", "r1")):
            heard = [payload for key, payload in self.world.bots[receiver].inbox if key == SYNC.format(sender)]
            assert heard == [count.to_bytes(4, "big") for count in range(self._count)]
            assert self.world.link(receiver, sender).connection == 1
            assert self.world.link(receiver, sender).state == "up"

    def warnings(self, robot: str = "r1") -> list[str]:
        return [note.text for note in self.world.bots[robot].notes if note.problem]


@pytest.fixture
def watched() -> Iterator[Watched]:
    found = Watched()
    yield found
    found.check_others()


def last_frame_again(end: End, data: bytes) -> bytes:
    return data + data


def bit_flipped(end: End, data: bytes) -> bytes:
    return data[:-9] + bytes((data[-9] ^ 1,)) + data[-8:]


def class_changed(end: End, data: bytes) -> bytes:
    return data[:2] + bytes((data[2] ^ 0x10,)) + data[3:]


def byte_missing(end: End, data: bytes) -> bytes:
    return data[:5] + data[6:]


def endless_length(end: End, data: bytes) -> bytes:
    return b"\xff\xff" + data[2:]


def forged_bye(end: End, data: bytes) -> bytes:
    return frames.encode_bye(frames.CLOSING) + data
