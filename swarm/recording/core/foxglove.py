"""Poses in the form that Foxglove draws: `foxglove.PoseInFrame`, with all fields of our own message beside it."""

import json
import math

from swarm.messages import Pose
from swarm.recording.core import json_text

POSE = "foxglove.PoseInFrame"
FRAME = "anchors"
"""The frame of reference of all poses: that of the UWB anchors."""

VIEW = frozenset(("timestamp", "frame_id", "pose"))
"""Fields that Foxglove reads, and that our own ones say already."""

_NUMBER = {"type": "number"}
_TIME = {"type": "object", "properties": {"sec": {"type": "integer"}, "nsec": {"type": "integer"}}}


def pose(message: Pose, log_time: int) -> bytes:
    """JSON text of a pose at a log time, ns. A robot whose heading is not known looks along x."""
    sec, nsec = divmod(log_time, 1_000_000_000)
    half = (message.heading or 0.0) / 2.0
    # Written out: the most frequent message of a recording, and the encoder takes five times as long.
    view = (
        f'{{"timestamp":{{"sec":{sec},"nsec":{nsec}}},"frame_id":"{FRAME}",'
        f'"pose":{{"position":{{"x":{message.x!r},"y":{message.y!r},"z":0.0}},'
        f'"orientation":{{"x":0.0,"y":0.0,"z":{math.sin(half)!r},"w":{math.cos(half)!r}}}}},'
    )
    return view.encode() + json_text.encode(message)[1:]


def pose_schema() -> bytes:
    """Return the JSON schema of such a pose."""
    own = json.loads(json_text.schema(Pose(0.0, 0, 0.0, 0.0, None, 0, ""), POSE))
    own["properties"] = {
        "timestamp": _TIME,
        "frame_id": {"type": "string"},
        "pose": {
            "type": "object",
            "properties": {
                "position": {"type": "object", "properties": dict.fromkeys("xyz", _NUMBER)},
                "orientation": {"type": "object", "properties": dict.fromkeys("xyzw", _NUMBER)},
            },
        },
        **own["properties"],
    }
    return json.dumps(own, separators=(",", ":")).encode()
