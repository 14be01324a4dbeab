"""Every message type survives the bus, and docs/reference/keys.md tells the truth about all of them."""

import dataclasses
import math
import re
import types
import typing
from pathlib import Path
from typing import Any

import msgpack
import pytest
from hypothesis import given
from hypothesis import strategies as st

from swarm.errors import PayloadError
from swarm.messages import AppState, SetLeds, SetMode, Status, Stop, read, topics, type_of
from swarm.messages.codec import Measured, Short, decode, encode
from swarm.messages.keys import STOP, key
from swarm.messages.service import MAX_STOP_TEXT, stop_payload

MAPS = st.dictionaries(
    st.sampled_from(["t", "origin", "reason", "severity"]),
    st.none() | st.integers(-(2**63), 2**64 - 1) | st.floats() | st.text(max_size=200) | st.binary(max_size=9),
)
"""Maps like a stop of this or another release."""

TYPES = sorted({*topics().values(), Stop}, key=lambda kind: kind.__name__)


def strategy(kind: Any) -> st.SearchStrategy[Any]:
    """Values of a field's type hint."""
    if kind == Measured:
        return st.floats(-1e7, 1e7)
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin is typing.Annotated:
        return strategy(arguments[0])
    if origin in (typing.Union, types.UnionType):
        return st.one_of(*map(strategy, arguments))
    if origin is tuple and arguments[-1] is not ...:
        return st.tuples(*map(strategy, arguments))
    if origin is tuple:
        return st.lists(strategy(arguments[0]), max_size=4).map(tuple)
    if origin is dict:
        return st.dictionaries(strategy(arguments[0]), strategy(arguments[1]), max_size=4)
    if dataclasses.is_dataclass(kind):
        hints = typing.get_type_hints(kind, include_extras=True)
        return st.builds(kind, **{name: strategy(hint) for name, hint in hints.items()})
    return {
        float: st.floats(allow_nan=False, allow_infinity=False),
        int: st.integers(-(2**63), 2**63 - 1),
        bool: st.booleans(),
        str: st.text(max_size=12),
        bytes: st.binary(max_size=12),
        type(None): st.none(),
    }[kind]


def test_every_text_of_a_command_to_the_mesh_is_short() -> None:
    """Answers and logs repeat it: a long one made an answer that the bus does not take."""
    commands = {kind for (service, topic), kind in topics().items() if service == "mesh" and topic.startswith("set/")}
    assert len(commands) >= 8
    for kind in commands:
        for name, hint in typing.get_type_hints(kind, include_extras=True).items():
            assert str not in (hint, *typing.get_args(hint)) or hint is Short, f"{kind.__name__}.{name}"


@given(st.sampled_from(TYPES).flatmap(strategy))
def test_a_message_is_decoded_as_it_was_encoded(message: object) -> None:
    kind = type(message)
    again = decode(kind, encode(message), "swarm/r0/test/x")
    assert again == message
    assert repr(again) == repr(message)  # the types of free values, and the sign of zeros


@given(st.sampled_from(TYPES), st.binary(max_size=64))
def test_any_bytes_are_read_or_refused(kind: type, payload: bytes) -> None:
    with pytest.raises(PayloadError):
        decode(kind, payload, "swarm/r0/test/x")


def is_command(topic: str) -> bool:
    return "set" in topic.split("/")


TELEMETRY = {kind for (_, topic), kind in topics().items() if not is_command(topic)}
COMMANDS = {kind for (_, topic), kind in topics().items() if is_command(topic)} - TELEMETRY


def with_more(value: Any) -> Any:
    """A message of a later release: one more field in each dataclass of it."""
    if dataclasses.is_dataclass(value):
        fields = {each.name: with_more(getattr(value, each.name)) for each in dataclasses.fields(value)}
        return {**fields, "of_a_later_release": [1, {"a": None}]}
    if isinstance(value, tuple):
        return [with_more(each) for each in value]
    if isinstance(value, dict):
        return {name: with_more(each) for name, each in value.items()}
    return value


@given(st.sampled_from(sorted(TELEMETRY, key=lambda kind: kind.__name__)).flatmap(strategy))
def test_a_field_of_a_later_release_is_ignored_in_telemetry(message: Any) -> None:
    kind = type(message)
    assert decode(kind, msgpack.packb(with_more(message)), "swarm/r0/test/x") == message


@given(st.sampled_from(sorted(COMMANDS, key=lambda kind: kind.__name__)).flatmap(strategy))
def test_a_field_of_a_later_release_is_refused_in_a_command(message: Any) -> None:
    kind = type(message)
    with pytest.raises(PayloadError, match="of_a_later_release: unknown field"):
        decode(kind, msgpack.packb(with_more(message)), "swarm/r0/test/x")


def test_a_field_that_an_earlier_release_lacks_has_its_default_or_is_named() -> None:
    links = {"t": 1.0, "links": [{"peer": "r1", "state": "up", "connection": 1, "rtt": None, "sent": 0, "received": 0}]}
    with pytest.raises(PayloadError, match=r"^swarm/r0/mesh/links: links\[0\].reason: missing$"):
        read("swarm/r0/mesh/links", msgpack.packb(links))
    links["links"][0]["reason"] = ""  # type: ignore[index]
    assert read("swarm/r0/mesh/links", msgpack.packb(links)).links[0].refused == 0  # type: ignore[attr-defined]


@given(st.text(max_size=40).map("swarm/r0/".__add__) | st.text(), st.binary(max_size=10))
def test_any_key_is_read_or_refused(text: str, payload: bytes) -> None:
    with pytest.raises(PayloadError):
        read(text, payload)


@given(st.binary(max_size=200) | MAPS.map(msgpack.packb))
def test_any_payload_under_the_stop_key_is_a_stop_with_bounded_texts(payload: bytes) -> None:
    stop = read(STOP, payload)
    assert isinstance(stop, Stop)
    assert math.isfinite(stop.t)
    assert max(len(stop.origin), len(stop.reason)) <= MAX_STOP_TEXT
    assert read(STOP, stop_payload(stop)) == stop


def test_a_stop_says_who_and_why_as_far_as_it_can_be_read() -> None:
    proper = {"t": 2.0, "origin": "r1", "reason": "enough"}
    assert read(STOP, msgpack.packb(proper)) == Stop(2.0, "r1", "enough")
    assert read(STOP, msgpack.packb({**proper, "severity": 3})) == Stop(2.0, "r1", "enough")
    assert read(STOP, msgpack.packb({"reason": "enough", "t": math.nan})) == Stop(0.0, "unknown", "enough")
    assert read(STOP, msgpack.packb({**proper, "origin": 7, "reason": ["x"]})) == Stop(2.0, "unknown", "")
    assert read(STOP, msgpack.packb({**proper, "reason": "x" * 60_000})).reason == "x" * MAX_STOP_TEXT
    for payload in (b"", b"stop!", msgpack.packb([1]), b"\x91" * 4000, bytes(900_000)):
        assert read(STOP, payload) == Stop(0.0, "unknown", "unreadable stop message")


@given(st.text(max_size=300), st.text(max_size=300), st.floats())
def test_any_stop_can_be_published(origin: str, reason: str, t: float) -> None:
    stop = read(STOP, stop_payload(Stop(t, origin, reason)))
    assert (stop.origin, stop.reason) in {
        (origin[:MAX_STOP_TEXT], reason[:MAX_STOP_TEXT]),
        ("unknown", "unreadable stop message"),
    }


def test_what_cannot_be_published_as_a_stop_is_published_empty() -> None:
    for message in (bytes(5000), Stop(0.0, "\ud800", ""), object()):
        assert stop_payload(message) == b""
    assert stop_payload(b"odd") == b"odd"


@pytest.mark.parametrize(
    ("text", "kind"),
    [
        (STOP, Stop),
        ("swarm/r0/mesh/status", Status),
        ("swarm/r0/app/consensus/status", Status),
        ("swarm/r0/app/consensus/state", AppState),
        ("swarm/r0/balancer/set/leds", SetLeds),
        ("swarm/r0/balancer/set/mode", SetMode),
        ("swarm/r0/balancer/set/other", None),
        ("swarm/r0/app/consensus/sync/1-2-3-4", None),
        ("swarm/r0/app/led_sync/frequency/state", AppState),
        ("swarm/r0/app/consensus/very/deep/state", None),
        ("swarm/r0/mesh/x/status", None),
        ("swarm/r0/mesh/alive", None),
    ],
)
def test_the_key_tells_the_type_of_its_message(text: str, kind: type | None) -> None:
    assert type_of(text) is kind


def test_every_topic_is_found_under_its_key() -> None:
    for (service, topic), kind in topics().items():
        assert type_of(key("r0", service.replace("*", "mesh"), topic.replace("*", "max"))) is kind


def test_an_unknown_key_is_refused_by_name() -> None:
    with pytest.raises(PayloadError, match="swarm/r0/mesh/nonsense: no message travels under this key"):
        read("swarm/r0/mesh/nonsense", b"\x80")


KEYS_PAGE = Path(__file__).parent.parent.parent.parent / "docs/reference/keys.md"


def documented() -> tuple[dict[str, str], dict[str, list[str]]]:
    """Key pattern -> type, and type -> field names, as docs/reference/keys.md has them."""
    text = KEYS_PAGE.read_text()
    keys = dict(re.findall(r"^\| `(swarm/[^`]+)` \|.*?\| \[(\w+)\]\(#\w+\) \|", text, flags=re.MULTILINE))
    fields: dict[str, list[str]] = {}
    for section in re.split(r"^### ", text, flags=re.MULTILINE)[1:]:
        name = section.split(maxsplit=1)[0]
        fields[name] = re.findall(r"^\| `(\w+)` \|", section.split("\n## ")[0], flags=re.MULTILINE)
    return keys, fields


def test_the_page_lists_every_key_and_no_other() -> None:
    def shown(service: str, topic: str) -> str:
        second = "<channel>" if topic.startswith("*/*") else "<topic>"
        topic = topic.replace("*", "<app>", 1).replace("*", second)
        return f"swarm/<robot>/{'<service>' if service == '*' else service}/{topic}"

    wanted = {shown(*place): kind.__name__ for place, kind in topics().items()}
    assert documented()[0] == wanted | {STOP: "Stop"}


def test_the_page_lists_every_field_in_order() -> None:
    def parts(kind: Any) -> set[type]:
        if dataclasses.is_dataclass(kind):
            return {typing.cast(type, kind)}.union(*map(parts, typing.get_type_hints(kind).values()))
        return set().union(*map(parts, typing.get_args(kind)))

    used = set().union(*map(parts, TYPES))
    wanted = {kind.__name__: [field.name for field in dataclasses.fields(kind)] for kind in used}
    assert documented()[1] == wanted
