"""Payloads: what goes in comes out, and anything else is refused by name."""

import gc
import math
import sys
import tracemalloc
from dataclasses import dataclass
from typing import Any

import msgpack
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from swarm.errors import LocalError, PayloadError
from swarm.messages.codec import MAX_PAYLOAD, Measured, Short, Value, decode, encode, unpack

KEY = "swarm/r0/test/thing"


@dataclass(frozen=True, slots=True)
class Part:
    name: str
    sizes: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class Thing:
    t: float
    on: bool
    part: Part
    parts: tuple[Part, ...]
    free: dict[str, Value]
    maybe: float | None = None


GOOD: dict[str, Any] = {
    "t": 1.5, "on": True, "part": {"name": "a", "sizes": [1, 2]}, "parts": [], "free": {},
}  # fmt: skip


def read(**changes: object) -> Thing:
    return decode(Thing, msgpack.packb(GOOD | changes), KEY)


def test_defaults_and_nested_messages_survive_the_codec() -> None:
    assert read() == Thing(1.5, True, Part("a", (1, 2)), (), {})
    assert decode(Thing, encode(read(maybe=2.0)), KEY) == read(maybe=2.0)


def test_messages_leave_nothing_behind_in_pythons_free_lists() -> None:
    """A tuple made of a generator does: one block for each message, until 2000 of each length lie there."""
    payload = encode(read(part={"name": "a", "sizes": [1, 2, 3]}, free={"a": [0.5] * 4}))
    gc.collect()  # which empties them
    for _ in range(100):
        decode(Thing, payload, KEY)
    before = sys.getallocatedblocks()
    for _ in range(1000):
        decode(Thing, payload, KEY)
    assert sys.getallocatedblocks() - before < 300


def test_an_integer_where_a_float_is_wanted_becomes_one() -> None:
    assert type(read(t=3).t) is float
    assert type(read(maybe=3).maybe) is float


def test_free_values_keep_their_type() -> None:
    free = {"a": 1, "b": 1.0, "c": True, "d": "x", "e": [1.5, 2]}
    read_back = read(free=free).free
    assert read_back == {**free, "e": (1.5, 2.0)}
    assert [type(value) for value in read_back.values()] == [int, float, bool, str, tuple]


@pytest.mark.parametrize(
    ("changes", "field", "wanted"),
    [
        ({"t": "now"}, "t", "a finite number, got 'now'"),
        ({"t": True}, "t", "a finite number, got True"),
        ({"t": float("nan")}, "t", "a finite number, got nan"),
        ({"t": float("inf")}, "t", "a finite number"),
        ({"t": None}, "t", "a finite number, got None"),
        ({"on": 1}, "on", "true or false, got 1"),
        ({"part": None}, "part", "a map of Part"),
        ({"part": {"name": b"a", "sizes": []}}, "part.name", "a text, got b'a'"),
        ({"part": {"name": "a", "sizes": [1, 2.0]}}, "part.sizes[1]", "an integer, got 2.0"),
        ({"part": {"name": "a", "sizes": {}}}, "part.sizes", "a list, got a map"),
        ({"parts": [GOOD["part"], 7]}, "parts[1]", "a map of Part, got 7"),
        ({"free": []}, "free", "a map, got a list"),
        ({"free": {"v": None}}, "free.v", "float | int | bool | str | tuple[float, ...], got None"),
        ({"free": {"v": {"w": 1}}}, "free.v", "got a map"),
        ({"free": {"v": [1.0, "x"]}}, "free.v[1]", "a finite number, got 'x'"),
        ({"free": {"v": float("nan")}}, "free.v", "a finite number"),
        ({"maybe": "x" * 500}, "maybe", "float | None, got 'xxx"),
    ],
)
def test_a_wrong_field_is_named(changes: dict[str, object], field: str, wanted: str) -> None:
    with pytest.raises(PayloadError) as caught:
        read(**changes)
    text = str(caught.value)
    assert text.startswith(f"{KEY}: {field}: expected ")
    assert wanted in text
    assert len(text) < 200


def test_missing_and_unknown_fields_are_named() -> None:
    with pytest.raises(PayloadError, match=rf"^{KEY}: part\.sizes: missing$"):
        read(part={"name": "a"})
    with pytest.raises(PayloadError, match=rf"^{KEY}: extra: unknown field, Thing has t, on, part"):
        read(extra=1)
    with pytest.raises(PayloadError) as caught:
        read(**{"x" * 5000: 1})
    assert len(str(caught.value)) < 200


@pytest.mark.parametrize(
    ("payload", "wanted"),
    [
        (b"", "payload is not msgpack"),
        (b"\xc1", "payload is not msgpack"),
        (b"hello", "payload is not msgpack"),
        (b"\x80\x80", "payload is not msgpack"),
        (b"\xa2\xff\xfe", "payload is not msgpack"),
        (b"\x91" * 5000, "payload is not msgpack"),
        (b"\x91" * 1000 + b"\x90", "expected a map of Thing, got a list"),
        (b"\x81\x01\x02", "payload is not msgpack"),
        (b"\x81\xc0\xc0", "payload is not msgpack"),
        (b"\x90", "payload: expected a map of Thing, got a list"),
        (b"\xc7\x03\xff000", "payload is not msgpack"),
        (bytes(MAX_PAYLOAD + 1), f"payload of {MAX_PAYLOAD + 1} bytes, at most {MAX_PAYLOAD} are accepted"),
    ],
)
def test_other_bytes_are_refused(payload: bytes, wanted: str) -> None:
    with pytest.raises(PayloadError) as caught:
        decode(Thing, payload, KEY)
    assert str(caught.value).startswith(f"{KEY}: ")
    assert wanted in str(caught.value)


@given(st.binary(max_size=200))
@example(msgpack.packb({"t": 2**63}))
@example(msgpack.packb(msgpack.Timestamp(5)))
@example(b"\xd7\xff" + b"\xff" * 8)
@example(b"\x81\xd6\xff\x00\x00\x00\x00\x01")
def test_any_bytes_are_read_or_refused(payload: bytes) -> None:
    for attempt in (lambda: unpack(payload), lambda: decode(Thing, payload, KEY)):
        try:
            attempt()
        except PayloadError:
            continue


WIRE = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | st.floats() | st.text(max_size=5)
    | st.binary(max_size=5),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner, max_size=4),
)  # fmt: skip


@given(st.dictionaries(st.sampled_from([*GOOD, "maybe", "more"]), WIRE))
def test_any_field_values_are_read_or_refused(changes: dict[str, object]) -> None:
    try:
        thing = read(**changes)
    except PayloadError:
        return
    assert decode(Thing, encode(thing), KEY) == thing


@pytest.mark.parametrize("value", [object(), 2**64, "\ud800", {1, 2}, 1j])
def test_what_cannot_be_packed_is_refused_by_name(value: Any) -> None:
    with pytest.raises(LocalError, match=r"^Part: "):
        encode(Part("a", (value,)))


def test_too_large_is_refused() -> None:
    with pytest.raises(LocalError, match=r"Part: .* the bus takes at most"):
        encode(Part("a" * MAX_PAYLOAD, ()))


@dataclass
class Fixed:
    pair: tuple[Short, float]


def test_a_fixed_tuple_has_its_number_of_entries_and_a_short_text_its_letters() -> None:
    assert decode(Fixed, msgpack.packb({"pair": ["a" * 64, 1]}), KEY) == Fixed(("a" * 64, 1.0))
    for pair, error in (
        (["a"], "pair: expected a list of 2"),
        (["a", 1, 2], "pair: expected a list of 2"),
        (["a", "b"], r"pair\[1\]: expected a finite number"),
        (["a" * 65, 1], r"pair\[0\]: expected a text of at most 64 letters"),
        ([1, 1], r"pair\[0\]: expected a text of at most 64 letters"),
    ):
        with pytest.raises(PayloadError, match=error):
            decode(Fixed, msgpack.packb({"pair": pair}), KEY)


@dataclass
class Loose:
    names: list[str]


@dataclass
class Unclear:
    either: tuple[int, ...] | tuple[str, ...]


@pytest.mark.parametrize("kind", [Loose, Unclear])
def test_types_a_message_cannot_hold(kind: type) -> None:
    with pytest.raises(LocalError, match="messages cannot"):
        decode(kind, b"\x80", KEY)


@pytest.mark.parametrize("head", [b"\xdc\xea\x60", b"\xdd\x00\x00\xea\x60"])
def test_lists_that_lie_about_their_lengths_take_no_memory(head: bytes) -> None:
    """Each level says that it has 60000 entries, and the message ends before."""
    payload = head * 1000 + bytes(MAX_PAYLOAD - 1000 * len(head))
    tracemalloc.start()
    try:
        with pytest.raises(PayloadError, match="not msgpack"):
            unpack(payload)
        assert tracemalloc.get_traced_memory()[1] < 16 * MAX_PAYLOAD
    finally:
        tracemalloc.stop()
    assert unpack(msgpack.packb([[1.0] * 1000] * 7)) == [[1.0] * 1000] * 7


@dataclass(frozen=True, slots=True)
class Place:
    x: Measured
    y: Measured | None = None


def test_a_number_of_a_sensor_is_bounded() -> None:
    for x in (1e7, -1e7, 3):
        assert decode(Place, encode(Place(x, x)), KEY) == Place(x, x)
    for x in (1.1e7, -1e300, math.nan, math.inf, 2**63):
        with pytest.raises(PayloadError, match="x: expected"):
            decode(Place, msgpack.packb({"x": x}), KEY)
