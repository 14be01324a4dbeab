"""What is known of the swarm: from any samples, in any order."""

import json
import math
import tracemalloc

import msgpack
import pytest
from hypothesis import given
from hypothesis import strategies as st

from laptop.view.feeds import picture as module
from laptop.view.feeds.history import HISTORY_S, HISTORY_STEP_S, MAX_KEY, MAX_ROBOT, History
from laptop.view.feeds.picture import (
    MAX_EVENTS,
    MAX_HOPS,
    MAX_PARTS,
    MAX_SERVICES,
    MAX_SIZE,
    MAX_SUBJECTS,
    MAX_TOPICS,
    Picture,
    track,
)
from swarm.errors import PayloadError
from swarm.messages import AppProgress, Links, LinkState, Pose, Status, topics
from swarm.messages.codec import MAX_PAYLOAD, encode
from swarm.messages.fields import check_fields

VALUES = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**63), 2**63)
    | st.floats()
    | st.text(max_size=5)
    | st.binary(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=10,
)


def shown(picture: Picture, since: int = 0) -> dict[str, dict[str, object]]:
    """Return what is newer than a version of the picture, by robot."""
    new = {robot: picture.values(robot, picture.since(robot, since, since)) for robot in picture.robots}
    return {robot: values for robot, values in new.items() if values}


def links(state: str, reason: str = "") -> Links:
    return Links(1.0, (LinkState("r1", state, 1, None, 0, 0, reason),))


@given(
    st.lists(st.tuples(st.sampled_from(["", "r0", "r1"]), st.text(max_size=30), st.binary(max_size=40)), max_size=20)
)
def test_no_sample_harms_the_picture(samples: list[tuple[str, str, bytes]]) -> None:
    picture = Picture()
    for bus, key, payload in samples:
        picture.take(bus, key, payload, 0.0)
        picture.take(bus, f"swarm/r0/mesh/{key}", payload, 0.0)
    json.dumps([shown(picture), picture.hops()], allow_nan=False)


@given(VALUES)
def test_whatever_a_key_holds_can_be_told_to_a_page(value: object) -> None:
    from laptop.view.feeds.picture import json_value

    picture = Picture()
    picture.put("r0", "mesh/links", json_value(value), 0.0)
    picture.put("r0", "app/x/progress", json_value(value), 0.0)
    json.dumps(
        [shown(picture), list(picture.history("r0", "mesh/links")), list(picture.trail("r0", 9.0, 0.0))],
        allow_nan=False,
    )


@given(st.lists(st.tuples(st.sampled_from(["r0", "r1"]), st.sampled_from(["a/b", "c/d"]), st.integers())), st.data())
def test_a_page_that_asks_now_and_then_ends_with_what_is_there(
    samples: list[tuple[str, str, int]], data: st.DataObject
) -> None:
    picture, page, version = Picture(), {}, 0
    for robot, topic, value in samples:
        picture.put(robot, topic, value, 0.0)
        if data.draw(st.booleans()):
            for name, topics in shown(picture, version).items():
                page.setdefault(name, {}).update(topics)
            version = picture.version
            assert shown(picture, version) == {}
    for name, topics in shown(picture, version).items():
        page.setdefault(name, {}).update(topics)
    assert page == shown(picture)


def test_only_the_own_bus_speaks_for_a_robot() -> None:
    picture = Picture()
    state = encode(Status(1.0, "mesh", "ready", "", 1, 0.0, {}))
    picture.take("r1", "swarm/r0/mesh/status", state, 0.0)
    assert shown(picture) == {}
    picture.take("r0", "swarm/r0/mesh/status", state, 0.0)
    assert set(shown(picture)) == {"r0"}
    picture.take("", "swarm/r5/mesh/status", state, 0.0)
    assert set(shown(picture)) == {"r0", "r5"}


def test_a_link_that_is_lost_and_mended_makes_two_lines() -> None:
    picture = Picture()
    for state, reason in (
        ("up", ""),
        ("up", ""),
        ("down", "silent for 3 s"),
        ("down", "silent for 3 s"),
        ("connecting", ""),
        ("up", ""),
    ):
        picture.take("r0", "swarm/r0/mesh/links", encode(links(state, reason)), 1.0)
    assert [(event.level, event.text) for event in picture.events] == [
        ("warning", "link to r1 down: silent for 3 s"),
        ("info", "link to r1 up"),
    ]


def test_a_fault_of_an_app_and_who_is_waited_for_are_told() -> None:
    picture = Picture()
    for phase, waiting, reason in (("running", (), ""), ("waiting", ("r1",), ""), ("fault", (), "step raised")):
        picture.take("r0", "swarm/r0/app/x/progress", encode(AppProgress(1.0, phase, 3, waiting, reason)), 1.0)
    assert [event.text for event in picture.events] == ["app/x waiting for r1", "app/x fault: step raised"]


def test_a_service_that_goes_is_told_once() -> None:
    picture = Picture()
    for there in (True, True, False, False, True):
        picture.alive("r0", "mesh", there, 0.0)
    assert [event.text for event in picture.events] == ["mesh is gone", "mesh is back"]
    assert picture.services() == {"r0": {"mesh": True}}


def test_an_app_that_ends_in_order_is_no_error_and_one_that_does_not_is() -> None:
    picture = Picture()
    for robot, state in (("r0", "stopping"), ("r1", "ready")):
        picture.alive(robot, "app/x", True, 0.0)
        picture.put(robot, "app/x/status", {"t": 1.0, "state": state, "reason": ""}, 1.0)
        picture.alive(robot, "app/x", False, 2.0)
    assert [(event.robot, event.level) for event in picture.events if event.text == "app/x is gone"] == [
        ("r0", "info"),
        ("r1", "error"),
    ]


def test_robots_that_wait_for_each_other_before_their_first_iteration_are_no_warning() -> None:
    picture = Picture()
    for k, level in ((0, "info"), (3, "warning")):
        picture.put("r0", "app/x/progress", {"t": 1.0, "phase": "running", "k": k}, 1.0)
        picture.put("r0", "app/x/progress", {"t": 1.0, "phase": "waiting", "k": k, "waiting_for": ["r1"]}, 1.0)
        assert picture.events[-1].level == level


def test_the_memory_of_a_picture_is_bounded() -> None:
    picture = Picture()
    for number in range(2 * MAX_TOPICS):
        picture.put("r0", f"app/x/mine/{number}", number, 0.0)
    assert len(shown(picture)["r0"]) == MAX_TOPICS
    assert picture.refused == MAX_TOPICS
    for number in range(2 * MAX_EVENTS):
        picture.alive("r0", "mesh", bool(number % 2), 0.0)
    assert len(picture.events) == MAX_EVENTS
    for number in range(10_000):
        picture.take("r1", "swarm/r1/dwm/pose", encode({"x": 1.0}), number * 0.1)
    assert 400 < len(list(picture.history("r1", "dwm/pose"))) <= HISTORY_S / HISTORY_STEP_S + 1


def test_a_trail_is_where_it_was_and_nothing_that_is_no_number() -> None:
    picture = Picture()
    for t, x in enumerate((0.0, 1.0, math.nan, 2.0)):
        picture.take("r0", "swarm/r0/dwm/pose", encode({"x": x, "y": 0.0}), float(t))
    picture.take("r0", "swarm/r0/dwm/pose", encode(Pose(1.0, 1, 3.0, 0.0, None, 9, "ekf")), 4.0)
    assert list(picture.trail("r0", 3.5, 4.0)) == [(1.0, 0.0), (2.0, 0.0), (3.0, 0.0)]


TOPICS = {f"{service}/{topic}".replace("*", "x"): kind for (service, topic), kind in topics().items()}
FIELDS = sorted({field for kind in TOPICS.values() for field in kind.__dataclass_fields__})


@given(
    st.sampled_from(sorted(TOPICS)),
    st.dictionaries(st.sampled_from(FIELDS), VALUES, max_size=4) | VALUES,
)
def test_a_page_finds_in_each_field_what_the_type_of_its_key_says_or_is_told_nothing(
    topic: str, message: object
) -> None:
    try:
        payload = msgpack.packb(message)
    except (ValueError, OverflowError):
        return
    picture = Picture()
    picture.take("r0", f"swarm/r0/{topic}", payload, 1.0)
    told = shown(picture).get("r0", {})
    if topic in told:
        check_fields(TOPICS[topic], told[topic])
        assert picture.refused == 0
    else:
        assert picture.refused == 1
        assert list(picture.history("r0", topic)) == []
        assert [event.level for event in picture.events] == ["warning"]


def test_a_wrong_message_is_counted_each_time_and_named_once_with_its_field() -> None:
    picture = Picture()
    for _ in range(3):
        picture.take("", "swarm/r1/mesh/links", encode({"links": 5}), 2.0)
    assert picture.refused == 3
    assert [event[1:] for event in picture.events] == [
        (2.0, "r1", "warning", "mesh/links is left out, and whatever is like it: links: expected a list, got 5")
    ]


def test_messages_with_fields_missing_or_unknown_are_shown() -> None:
    """As they come over the mesh, or from another release."""
    picture = Picture()
    picture.take("", "swarm/r1/mesh/links", encode({"links": [{"peer": "r0", "state": "up", "colour": 7}]}), 0.0)
    assert picture.newest("r1", "mesh/links") == {"links": [{"peer": "r0", "state": "up", "colour": 7}]}
    assert picture.refused == 0


def test_a_robot_that_names_ever_new_things_fills_no_memory() -> None:
    picture = Picture()
    for number in range(2 * MAX_HOPS):
        picture.passed(f"x{number}", "r0", 1)
        picture.alive("r0", f"x{number}", True, 0.0)
    for number in range(2 * MAX_SUBJECTS):
        link = LinkState(f"x{number}", "down", 1, None, 0, 0, "x" * 9000)
        picture.take("r0", "swarm/r0/mesh/links", encode(Links(1.0, (link,))), 0.0)
    assert len(picture.hops()) == MAX_HOPS
    assert len(picture.services()["r0"]) == MAX_SERVICES
    assert len(picture.events) == MAX_SUBJECTS
    assert max(len(event.text) for event in picture.events) <= 200


@given(st.text())
def test_no_text_of_a_robot_steers_who_reads_its_events(text: str) -> None:
    picture = Picture()
    picture.put("r0", "balancer/fault", {"name": text, "reason": text}, 0.0)
    assert all(event.text.isprintable() for event in picture.events)


def test_a_wrong_field_is_named_with_its_place() -> None:
    with pytest.raises(PayloadError, match=r"links\[1\].state: expected a text, got 4"):
        check_fields(Links, {"links": [{"peer": "r0"}, {"state": 4}]})


@given(st.lists(st.tuples(st.sampled_from("abc"), st.integers(0, 40), st.floats(-1.0, 3.0)), max_size=60))
def test_a_history_ends_with_the_newest_and_is_bounded(samples: list[tuple[str, int, float]]) -> None:
    history, now, newest = History(), 0.0, {}
    for topic, size, step in samples:
        now += step
        history.add(topic, bytes(size << 14), now)
        times = [t for t, _ in history.rows(topic)]
        newest.setdefault(topic, now)
        if not newest[topic] <= now < newest[topic] + HISTORY_STEP_S:
            newest[topic] = now
        assert times[-1] == newest[topic]
        assert sum(len(payload) for _, payload in list(history.rows(topic))[1:]) <= MAX_KEY
    assert sum(len(payload) for topic in newest for _, payload in history.rows(topic)) <= MAX_ROBOT + (3 << 20)


def test_what_a_robot_says_at_its_most_takes_a_bounded_amount_of_memory() -> None:
    """Two minutes of the largest messages under as many keys as there may be; a page asks for one key of texts."""
    picture = Picture()
    tracemalloc.start()
    try:
        for t in range(0, int(HISTORY_S), 4):
            for number in range(MAX_TOPICS):
                picture.take("r0", f"swarm/r0/app/x/mine/{number}", bytes(MAX_PAYLOAD), float(t))
        kept = tracemalloc.get_traced_memory()[0]
    finally:
        tracemalloc.stop()
    assert kept < MAX_SIZE + MAX_ROBOT + (1 << 20)
    payload = msgpack.packb(["abcdef"] * 9000)
    for t in range(int(HISTORY_S), 2 * int(HISTORY_S), 4):
        picture.take("r1", "swarm/r1/app/x/mine/1", payload, float(t))
    rows = list(picture.history("r1", "app/x/mine/1"))
    assert MAX_KEY - 2 * MAX_PAYLOAD <= len(rows) * len(payload) <= MAX_KEY


def test_two_pages_that_look_at_the_same_time_are_told_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each in its thread: one looks while the other one decodes."""
    told: list[dict[str, dict[str, object]]] = []
    message = module._message

    def slow(topic: str, payload: bytes) -> object:
        if not told:
            told.append({})
            told.append(shown(picture))
        return message(topic, payload)

    monkeypatch.setattr(module, "_message", slow)
    picture = Picture()
    picture.take("r0", "swarm/r0/app/x/mine", msgpack.packb([1]), 0.0)
    assert told == []
    assert shown(picture) == told[1] == {"r0": {"app/x/mine": [1]}}


def test_a_look_back_at_a_robot_takes_no_more_than_a_look_at_it_now() -> None:
    """Each key is large for an instant only, which fits beside the others at any time, and its large value is kept."""
    picture = Picture()
    large, small = msgpack.packb(["abcdef"] * 9000), msgpack.packb([])
    for number in range(64):
        picture.take("r0", f"swarm/r0/app/x/mine/{number}", large, 0.0)
        picture.take("r0", f"swarm/r0/app/x/mine/{number}", small, 0.1)
    then = picture.look("r0", 0.1)
    assert MAX_SIZE - len(large) <= len(then) * len(large) <= MAX_SIZE


def test_a_message_of_more_values_than_a_page_could_go_through_is_left_out_and_named() -> None:
    picture = Picture()
    most = {"t": 1.0, "links": [{}] * (MAX_PARTS - 2)}
    picture.take("r1", "swarm/r1/mesh/links", msgpack.packb(most), 0.0)
    assert picture.newest("r1", "mesh/links") == most
    picture.take("r1", "swarm/r1/mesh/links", msgpack.packb(most | {"one": 1}), 1.0)
    assert picture.newest("r1", "mesh/links") == most
    assert "the page takes 10000" in picture.events_since(0)[-1].text


def test_numbers_that_no_float_can_be_are_no_places() -> None:
    rows: list[tuple[float, object]] = [(0.0, {"x": 10**400, "y": 0}), (1.0, {"x": 1, "y": 2})]
    assert list(track(rows, 0.0)) == [(1.0, 2.0)]
