"""JSON from elsewhere: whatever it is, it is read or refused with one error, and what was read can be written again."""

import contextlib
import json
import math
from typing import Any

import msgpack
import pytest
from hypothesis import given
from hypothesis import strategies as st

from swarm.errors import PayloadError
from swarm.messages.json_input import MAX_DEPTH, read_json

JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(st.characters()),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(st.characters()), inner, max_size=4),
)
"""Python's idea of JSON: NaN and infinities, endless integers and halves of surrogate pairs are in it."""


def is_clean(value: Any) -> bool:
    if isinstance(value, dict):
        return all(is_clean(name) and is_clean(item) for name, item in value.items())
    if isinstance(value, list):
        return all(map(is_clean, value))
    if isinstance(value, float):
        return math.isfinite(value)
    if isinstance(value, int):
        return -(2**63) <= value < 2**64
    return not isinstance(value, str) or not any(0xD800 <= ord(letter) < 0xE000 for letter in value)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "{",
        "[" * 4000,
        "[" * 100_000,
        "[" * 500 + "]" * 500,
        '{"a":' * 4000,
        "1" + "0" * 400,
        "1" * 5000,
        "1e999",
        "NaN",
        "[-Infinity]",
        '"\\ud800"',
        '{"\\udfff": 1}',
        b"\xff",
        b"\xff\xfe",
    ],
)
def test_what_is_no_json_for_others_is_refused(text: str | bytes) -> None:
    with pytest.raises(PayloadError, match="no JSON"):
        read_json(text)


@given(JSON)
def test_what_is_read_is_clean_and_what_is_clean_is_read(value: Any) -> None:
    text = json.dumps(value)
    if is_clean(value):
        assert read_json(text) == json.loads(text)
        msgpack.packb(read_json(text))
        json.dumps(read_json(text), allow_nan=False, ensure_ascii=False).encode()
    else:
        with pytest.raises(PayloadError):
            read_json(text)


@given(st.text() | st.binary())
def test_any_text_is_read_or_refused_with_one_error(text: str | bytes) -> None:
    with contextlib.suppress(PayloadError):
        read_json(text)


def test_documents_as_deep_as_the_limit_are_read() -> None:
    for depth in range(MAX_DEPTH):
        assert read_json("[" * depth + "1" + "]" * depth) is not None
    with pytest.raises(PayloadError):
        read_json("[" * MAX_DEPTH + "1" + "]" * MAX_DEPTH)
