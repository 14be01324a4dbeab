"""The swarm as Foxglove's 3D panel shows it: robots, links, ranges, anchors and target as a `foxglove.SceneUpdate`.

Pure: from the newest samples of a picture. Lengths are m, in the frame of the anchors.
"""

import json
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from laptop.foxglove.messages import FoxgloveMessage, float_or_none, rotation, timestamp
from laptop.view.feeds.picture import Picture, pose_topic
from swarm.config.types import Config
from swarm.core.graph import Edge, pair_of
from swarm.recording.core import foxglove

SCENE = "/scene"
BODY_RADIUS, BODY_HEIGHT = 0.055, 0.11
"""Size of a Balboa 32U4 with its wheels of 80 mm, m."""

_KINDS = ("arrows", "cubes", "spheres", "cylinders", "lines", "triangles", "texts", "models")
_LINE_LIST = 2
"""The kind of line in which every two points make a line."""

Color = tuple[float, float, float, float]
_ROBOT: Color = (0.0, 0.45, 0.70, 1.0)
_STOPPED: Color = (0.84, 0.15, 0.16, 1.0)
_UP: Color = (0.0, 0.62, 0.45, 0.9)
_DOWN: Color = (0.84, 0.15, 0.16, 0.9)
_RANGE: Color = (0.6, 0.6, 0.6, 0.4)
_ANCHOR: Color = (0.35, 0.35, 0.35, 1.0)
_TARGET: Color = (0.9, 0.62, 0.0, 1.0)

Place = tuple[float, float, float]
"""x and y, m, and heading, rad."""


def robot_poses(picture: Picture, config: Config) -> dict[str, Place]:
    """Return the places of robots: the true ones where they are known (a simulation), else their estimates."""
    found = {}
    for robot in config.names:
        topic = pose_topic(picture.topics(robot))
        value = picture.newest(robot, topic)
        place = _xy(value)
        if place is not None and isinstance(value, dict) and (topic == "sim/truth" or value.get("quality")):
            found[robot] = (*place, float_or_none(value.get("heading")) or 0.0)
    return found


def _xy(value: object) -> tuple[float, float] | None:
    """Return the place that a message holds, m; None where it holds none."""
    x, y = (float_or_none(value.get(name)) for name in "xy") if isinstance(value, dict) else (None, None)
    return None if x is None or y is None else (x, y)


def scene_update(picture: Picture, config: Config, log_time: int) -> FoxgloveMessage:
    """Return the drawing at a log time, ns since 1970. Each entity replaces the one of its name."""
    where = robot_poses(picture, config)
    entities = [
        *(_robot(robot, place, picture, log_time) for robot, place in where.items()),
        _entity("links", log_time, lines=[_lines(_links(picture, config, where), 0.012)]),
        _entity("ranges", log_time, lines=[_lines(_ranges(picture, config, where), 0.004)]),
        _entity("anchors", log_time, cubes=[_cube(each) for each in config.anchors], texts=_names(config)),
    ]
    if (target := _target(picture, config)) is not None:
        entities.append(_entity("target", log_time, spheres=[_shape(*target, 0.08, (0.08, 0.08, 0.08), _TARGET)]))
    data = json.dumps({"deletions": [], "entities": entities}, separators=(",", ":")).encode()
    return FoxgloveMessage(SCENE, "foxglove.SceneUpdate", _SHAPE, data)


def _robot(robot: str, place: Place, picture: Picture, log_time: int) -> dict[str, Any]:
    x, y, heading = place
    stopped = picture.newest(robot, "mesh/stopped")
    fault = picture.newest(robot, "balancer/fault")
    bad = (isinstance(stopped, dict) and stopped.get("stopped")) or (isinstance(fault, dict) and fault.get("name"))
    size = (2 * BODY_RADIUS, 2 * BODY_RADIUS, BODY_HEIGHT)
    body = {
        **_shape(x, y, BODY_HEIGHT / 2, size, _STOPPED if bad else _ROBOT, heading),
        "bottom_scale": 1.0,
        "top_scale": 0.8,
    }
    nose = {
        "pose": _pose(x, y, BODY_HEIGHT, heading),
        "shaft_length": BODY_RADIUS,
        "shaft_diameter": 0.012,
        "head_length": 0.03,
        "head_diameter": 0.03,
        "color": _color(_ROBOT),
    }
    return _entity(robot, log_time, cylinders=[body], arrows=[nose], texts=[_text(robot, x, y, 2 * BODY_HEIGHT)])


def _links(
    picture: Picture, config: Config, where: Mapping[str, Place]
) -> Iterator[tuple[Sequence[float], Sequence[float], Color]]:
    """Yield each link once: up where one of its ends reports so."""
    states: dict[Edge, bool] = {}
    for robot in config.names:
        value = picture.newest(robot, "mesh/links")
        links = value.get("links") if isinstance(value, dict) else None
        for link in links or ():
            pair = pair_of(robot, str(link.get("peer")))
            states[pair] = states.get(pair, False) or link.get("state") == "up"
    for (one, other), up in states.items():
        if one in where and other in where:
            yield (*where[one][:2], 0.03), (*where[other][:2], 0.03), _UP if up else _DOWN


def _ranges(
    picture: Picture, config: Config, where: Mapping[str, Place]
) -> Iterator[tuple[Sequence[float], Sequence[float], Color]]:
    """Yield a line from each robot to each anchor that it has measured lately."""
    anchors = {anchor.address: anchor for anchor in config.anchors}
    for robot, (x, y, _) in where.items():
        value = picture.newest(robot, "dwm/ranges")
        ranges = value.get("ranges") if isinstance(value, dict) else None
        for each in ranges or ():
            anchor = anchors.get(str(each.get("anchor")))
            if anchor is not None and not each.get("stale"):
                yield (x, y, BODY_HEIGHT), (anchor.x, anchor.y, anchor.z), _RANGE


def _target(picture: Picture, config: Config) -> tuple[float, float] | None:
    places = (_xy(picture.newest(robot, "sim/target")) for robot in config.names)
    return next((place for place in places if place is not None), None)


def _cube(anchor: Any) -> dict[str, Any]:
    return _shape(anchor.x, anchor.y, anchor.z, (0.05, 0.05, 0.05), _ANCHOR)


def _names(config: Config) -> list[dict[str, Any]]:
    return [_text(anchor.address, anchor.x, anchor.y, anchor.z + 0.08) for anchor in config.anchors]


def _entity(name: str, log_time: int, **drawn: list[dict[str, Any]]) -> dict[str, Any]:
    head = {
        "timestamp": timestamp(log_time),
        "frame_id": foxglove.FRAME,
        "id": name,
        "lifetime": {"sec": 0, "nsec": 0},
        "frame_locked": False,
        "metadata": [],
    }
    return {**head, **{kind: drawn.get(kind, []) for kind in _KINDS}}


def _shape(
    x: float, y: float, z: float, size: tuple[float, float, float], color: Color, heading: float = 0.0
) -> dict[str, Any]:
    return {
        "pose": _pose(x, y, z, heading),
        "size": dict(zip("xyz", size, strict=True)),
        "color": _color(color),
    }


def _lines(found: Iterator[tuple[Sequence[float], Sequence[float], Color]], thickness: float) -> dict[str, Any]:
    points, colors = [], []
    for one, other, color in found:
        points += [dict(zip("xyz", each, strict=True)) for each in (one, other)]
        colors += [_color(color)] * 2
    return {
        "type": _LINE_LIST,
        "pose": _pose(0.0, 0.0, 0.0),
        "thickness": thickness,
        "scale_invariant": False,
        "points": points,
        "color": _color(_RANGE),
        "colors": colors,
        "indices": [],
    }


def _text(text: str, x: float, y: float, z: float) -> dict[str, Any]:
    return {
        "pose": _pose(x, y, z),
        "billboard": True,
        "font_size": 0.08,
        "scale_invariant": False,
        "color": _color(_ANCHOR),
        "text": text,
    }


def _pose(x: float, y: float, z: float, heading: float = 0.0) -> dict[str, Any]:
    return {"position": {"x": x, "y": y, "z": z}, "orientation": rotation(heading)}


def _color(color: Color) -> dict[str, float]:
    return dict(zip("rgba", color, strict=True))


_SHAPE: dict[str, object] = {"deletions": ({},), "entities": ({},)}
"""All that the schema says of a scene, two lists of objects: Foxglove knows its own by name."""
