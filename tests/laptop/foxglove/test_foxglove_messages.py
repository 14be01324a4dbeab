"""What Foxglove is told of a swarm."""

import json
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from laptop.foxglove import scene
from laptop.foxglove.messages import FoxgloveMessage, frames, log, sample
from laptop.view.feeds.picture import Picture
from swarm.config import parse
from swarm.config.example import EXAMPLE
from swarm.config.types import Config
from swarm.messages import Links, LinkState, Pose, Range, Ranges
from swarm.messages.codec import encode

NOW = 1_700_000_000_123_456_789
VALUES = st.recursive(
    st.none() | st.booleans() | st.integers(-(10**400), 10**400) | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=10,
)


@pytest.fixture(scope="module")
def config() -> Config:
    return parse(EXAMPLE, Path("swarm.toml"))


def entities(message: FoxgloveMessage) -> dict[str, Any]:
    return {entity["id"]: entity for entity in json.loads(message.data)["entities"]}


def told(picture: Picture, robot: str, topic: str, message: object) -> None:
    picture.take("", f"swarm/{robot}/{topic}", encode(message), 1.0)


def test_a_pose_has_foxgloves_fields_beside_its_own() -> None:
    message = sample("r0", "dwm/pose", {"t": 1.0, "sequence": 3, "x": 1.5, "y": 2.0, "heading": None, "quality": 80,
                                        "source": "ekf"}, NOW)  # fmt: skip
    assert message is not None
    assert (message.topic, message.schema_name) == ("swarm/r0/dwm/pose", "foxglove.PoseInFrame")
    value = json.loads(message.data)
    assert value["pose"]["position"] == {"x": 1.5, "y": 2.0, "z": 0.0}
    assert value["timestamp"] == {"sec": 1_700_000_000, "nsec": 123_456_789}
    assert value["source"] == "ekf"


def test_an_apps_state_keeps_its_name_and_fields() -> None:
    message = sample("r1", "app/consensus/state", {"t": 1.0, "k": 7, "state": {"value": 0.1}}, NOW)
    assert message is not None
    assert (message.topic, message.schema_name) == ("swarm/r1/app/consensus/state", "consensus.state")
    assert json.loads(message.data)["state"]["value"] == 0.1
    assert json.loads(message.schema)["properties"]["state"]["properties"]["value"] == {"type": "number"}


def test_the_schema_of_a_topic_whose_first_message_is_empty_holds_for_those_that_follow() -> None:
    message = sample("r0", "mesh/members", {"t": 1.0, "members": [], "changes": []}, NOW)
    assert message is not None
    change = {"t": 2.0, "robot": "r1", "what": "join"}
    assert misfit({"t": 2.0, "members": [], "changes": [change]}, json.loads(message.schema)) == ""


def test_the_scene_has_robots_links_ranges_and_anchors(config: Config) -> None:
    picture = Picture()
    one, other = config.names[:2]
    for x, robot in enumerate((one, other)):
        told(picture, robot, "dwm/pose", Pose(1.0, 1, float(x), 0.5, 0.0, 90, "ekf"))
    told(picture, one, "mesh/links", Links(1.0, (LinkState(other, "up", 1, 0.03, 5, 5, ""),)))
    anchor = config.anchors[0]
    told(picture, one, "dwm/ranges", Ranges(1.0, 1, (Range(anchor.address, 1.0, 1.0, 90, 0.0, 1),)))
    found = entities(scene.scene_update(picture, config, NOW))
    assert found[one]["texts"][0]["text"] == one
    assert found[other]["cylinders"][0]["pose"]["position"]["x"] == 1.0
    (link,) = found["links"]["lines"]
    assert [point["x"] for point in link["points"]] == [0.0, 1.0]
    (ranges,) = found["ranges"]["lines"]
    assert (ranges["points"][1]["x"], ranges["points"][1]["y"]) == (anchor.x, anchor.y)
    assert len(found["anchors"]["cubes"]) == len(config.anchors)
    assert "target" not in found


def test_a_robot_without_a_fix_is_not_drawn(config: Config) -> None:
    picture = Picture()
    told(picture, "r0", "dwm/pose", Pose(1.0, 1, 1.0, 1.0, 0.0, 0, "ekf"))
    assert scene.robot_poses(picture, config) == {}


def test_the_log_and_the_frames_are_foxgloves(config: Config) -> None:
    picture = Picture()
    picture.note(1.0, "r2", "error", "mesh is gone")
    (line,) = log(picture.events, NOW)
    assert json.loads(line.data) | {"level": 4, "message": "mesh is gone", "name": "r2"} == json.loads(line.data)
    message = frames({"r0": (1.0, 2.0, 0.0)}, NOW)
    assert message.schema == frames({}, NOW).schema, "a topic has the schema of its first message, without robots maybe"
    (transform,) = json.loads(message.data)["transforms"]
    assert json.loads(message.schema)["properties"]["transforms"]["items"]["properties"].keys() == transform.keys()
    assert transform["child_frame_id"] == "r0"
    assert transform["translation"] == {"x": 1.0, "y": 2.0, "z": 0.0}


FIELDS = ["x", "y", "t", "heading", "quality", "links", "ranges", "stopped", "sequence", "source"]
TOPICS = ["dwm/pose", "sim/truth", "sim/target", "mesh/links", "dwm/ranges", "mesh/stopped"]


@given(st.sampled_from(TOPICS), st.dictionaries(st.sampled_from(FIELDS), VALUES, max_size=5))
def test_no_sample_of_a_robot_spoils_the_scene(config: Config, topic: str, value: dict[str, object]) -> None:
    from swarm.messages.json_values import json_value

    picture = Picture()
    picture.put("r0", topic, json_value(value), 0.0)
    json.loads(scene.scene_update(picture, config, NOW).data)
    if (held := picture.newest("r0", topic)) is not None and (message := sample("r0", topic, held, NOW)) is not None:
        json.loads(message.data)
        json.loads(message.schema)


JSON_TYPES = {
    "object": dict, "array": list, "string": str, "boolean": bool, "integer": int, "number": (int, float, type(None))
}  # fmt: skip
"""Types of JSON values by their names in a schema. NaN is written as null."""


def misfit(value: Any, schema: dict[str, Any], path: str = "") -> str:
    """Where a value contradicts its JSON schema; empty where it does not."""
    if not isinstance(value, JSON_TYPES[schema["type"]]):
        return f"{path}: {value!r} is no {schema['type']}"
    shapes = schema.get("properties", {})
    parts = [(key, value[key], shapes[key]) for key in shapes.keys() & value.keys()] if shapes else []
    if schema["type"] == "array":
        parts = [(str(index), each, schema["items"]) for index, each in enumerate(value)]
    return next(filter(None, (misfit(part, shape, f"{path}.{key}") for key, part, shape in parts)), "")


def test_a_merged_recording_has_the_topics_that_are_served_live(tmp_path: Path) -> None:
    from mcap.reader import make_reader

    from laptop.cli import main

    with pytest.raises(SystemExit, match="0"):
        main(["sim", "localization", "--virtual", "--robots", "3", "--seconds", "2", "--record", str(tmp_path / "run")])
    (run,) = [path.parent for path in (tmp_path / "run").rglob("*.mcap")]
    with pytest.raises(SystemExit, match="0"):
        main(["export", str(run), "--mcap", str(tmp_path / "all.mcap")])
    with (tmp_path / "all.mcap").open("rb") as file:
        messages = list(make_reader(file).iter_messages())
    found = {channel.topic: (schema, message) for schema, channel, message in messages}
    for schema, channel, message in messages:
        assert misfit(json.loads(message.data), json.loads(schema.data)) == "", channel.topic
    assert {"/scene", "/tf", "/log", "swarm/r0/app/localization/parameters"} <= found.keys()
    assert json.loads(found["/log"][1].data)["name"] in ("r0", "r1", "r2")
    schema, message = found["/scene"]
    assert schema.name == "foxglove.SceneUpdate"
    drawn = {entity["id"]: entity for entity in json.loads(message.data)["entities"]}
    assert {"r0", "r1", "r2", "links", "ranges", "anchors"} <= drawn.keys()
    assert len(drawn["links"]["lines"][0]["points"]) == 4, "a line of three robots has two links"
