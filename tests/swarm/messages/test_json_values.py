"""Values for readers of JSON."""

import json

from hypothesis import given
from hypothesis import strategies as st

from swarm.messages.json_values import json_value

leaves = st.none() | st.booleans() | st.integers() | st.floats() | st.text() | st.binary()
values = st.recursive(
    leaves,
    lambda inner: (
        st.lists(inner, max_size=4)
        | st.lists(inner, max_size=4).map(tuple)
        | st.dictionaries(st.text(), inner, max_size=4)
    ),
)


@given(values)
def test_whatever_a_message_holds_is_json(value: object) -> None:
    json.dumps(json_value(value), allow_nan=False)


def test_lists_stay_lists_whichever_reader_made_them() -> None:
    """The reader of bus messages makes lists, the reader of recordings tuples."""
    assert json_value({"links": ({"peer": "r1"}, (1, [2.5]))}) == {"links": [{"peer": "r1"}, [1, [2.5]]]}


def test_what_json_has_not_is_said_in_text() -> None:
    assert json_value([float("nan"), float("-inf"), b"\x01\xff"]) == ["nan", "-inf", "01ff"]
    assert json_value(b"\x01\x02\x03", 2) == "0102"


def test_endless_depth_ends_in_dots() -> None:
    deep: object = 0
    for _ in range(100):
        deep = [deep]
    assert "..." in json.dumps(json_value(deep))
