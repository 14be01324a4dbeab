"""The first frame of a link, as a test writes it by hand."""

from services.mesh.core.wire import frames
from services.mesh.core.wire.frames import Hello

KEYS = {0x68A1F0C2: bytes(range(32))}


def hello(robot: str = "r0", **changes: object) -> bytes:
    values = {
        "network": "lab",
        "robot": robot,
        "incarnation": 0,  # it tells no process, so it is no second robot
        "nonce": bytes(16),
        "dialler": True,
        "insecure": True,
    }
    return frames.encode_hello(Hello(**(values | changes)))  # type: ignore[arg-type]
