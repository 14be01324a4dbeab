"""The messages of robots as messages that Foxglove draws: pure, from the newest samples of a picture.

Topics and fields are those of a recording (docs/reference/recordings.md), so that one layout serves both. What Foxglove
draws by itself (poses, frames, the scene, the log) has the fields of its own schemas beside ours.
"""

import dataclasses
import json
import math
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, NamedTuple

from laptop.view.feeds.picture import Event
from swarm.errors import LocalError, PayloadError
from swarm.messages import Pose, type_of
from swarm.messages.json_values import is_number
from swarm.recording.core import foxglove, json_text

POSE_TOPIC = "dwm/pose"
FRAMES = "/tf"
LOG = "/log"

_POSE_FIELDS = tuple(field.name for field in dataclasses.fields(Pose))
_POSE_NEEDS = frozenset(field.name for field in dataclasses.fields(Pose) if field.default is dataclasses.MISSING)

_LEVELS = {"info": 2, "warning": 3, "error": 4}
"""The levels of `foxglove.Log`."""


class FoxgloveMessage(NamedTuple):
    """One message on its way to Foxglove."""

    topic: str
    schema_name: str
    value: object
    """The value from which the schema is made; a pose has a schema of its own."""
    data: bytes
    """JSON text."""
    kind: type | None = None
    """The class of the message on the bus, which also tells the types of what `value` has none of."""

    @property
    def schema(self) -> bytes:
        """Return the JSON schema, which a topic gets with its first message."""
        if self.schema_name == foxglove.POSE:
            return foxglove.pose_schema()
        if self.kind is not None and isinstance(self.value, Mapping):
            return json_text.schema_of(self.kind, self.value, self.schema_name)
        return json_text.schema(self.value, self.schema_name)


def sample(robot: str, topic: str, value: object, log_time: int) -> FoxgloveMessage | None:
    """Return a robot's sample at a log time, ns since 1970, under the key that it has on the bus; None where JSON
    cannot carry it. `value` is what the key holds: maps, lists, texts and numbers."""
    key = f"swarm/{robot}/{topic}"
    kind = _kind(key)
    try:
        if topic == POSE_TOPIC:
            if not isinstance(value, dict) or not value.keys() >= _POSE_NEEDS:
                return None
            known = {field: value[field] for field in _POSE_FIELDS if field in value}
            pose = Pose(**{**known, "heading": float_or_none(value["heading"])})
            return FoxgloveMessage(key, foxglove.POSE, pose, foxglove.pose(pose, log_time))
        return FoxgloveMessage(key, _schema_name(kind, topic), value, json_text.encode(value), kind)
    except LocalError:
        return None


def _kind(key: str) -> type | None:
    """Return the class of a key's messages; None where it has none."""
    try:
        return type_of(key)
    except PayloadError:
        return None


def _schema_name(kind: type | None, topic: str) -> str:
    """Return the name of the message's class; of an app's state the app's name, as every app has other fields."""
    service, *rest = topic.split("/")
    if service == "app" and rest[-1] == "state":
        return ".".join(rest)
    return topic.replace("/", ".") if kind is None else f"swarm.{kind.__name__}"


def frames(places: Mapping[str, tuple[float, float, float]], log_time: int) -> FoxgloveMessage:
    """Return a frame of reference for each robot: x and y, m, and heading, rad, in the frame of the anchors."""
    transforms = [_transform(robot, *place, log_time) for robot, place in places.items()]
    data = _packed({"transforms": transforms})
    # The first message may have no robot in it, and its schema holds for those that follow.
    return FoxgloveMessage(FRAMES, "foxglove.FrameTransforms", {"transforms": [_transform("", 0.0, 0.0, 0.0, 0)]}, data)


def _transform(robot: str, x: float, y: float, heading: float, log_time: int) -> dict[str, Any]:
    return {
        "timestamp": timestamp(log_time),
        "parent_frame_id": foxglove.FRAME,
        "child_frame_id": robot,
        "translation": {"x": x, "y": y, "z": 0.0},
        "rotation": rotation(heading),
    }


def log(events: Iterable[Event], log_time: int) -> Iterator[FoxgloveMessage]:
    """Yield a line for each event."""
    for event in events:
        line = {
            "timestamp": timestamp(log_time),
            "level": _LEVELS.get(event.level, 2),
            "message": event.text,
            "name": event.robot,
            "file": "",
            "line": 0,
        }
        yield FoxgloveMessage(LOG, "foxglove.Log", line, _packed(line))


def float_or_none(value: object) -> float | None:
    """Return a number as a float; None for other values."""
    return float(value) if is_number(value) else None


def timestamp(log_time: int) -> dict[str, int]:
    """Return a time, ns since 1970, as Foxglove writes it."""
    sec, nsec = divmod(log_time, 1_000_000_000)
    return {"sec": sec, "nsec": nsec}


def rotation(heading: float) -> dict[str, float]:
    """Return a rotation about the vertical axis, rad, as a quaternion."""
    return {"x": 0.0, "y": 0.0, "z": math.sin(heading / 2.0), "w": math.cos(heading / 2.0)}


def _packed(value: dict[str, Any]) -> bytes:
    return json.dumps(value, separators=(",", ":")).encode()
