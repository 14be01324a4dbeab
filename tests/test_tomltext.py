"""TOML that we write: read again it is the same document, and it looks as people would write it."""

import tomllib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from swarm.core.tomltext import dump
from swarm.errors import LocalError

texts = st.text(st.characters(exclude_categories=("Cs",)), max_size=12)
plain = st.booleans() | st.integers(-(2**63), 2**63 - 1) | st.floats(allow_nan=False) | texts
values = st.recursive(
    plain,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(texts, inner, max_size=3),
    max_leaves=12,
)


@given(st.dictionaries(texts, values, max_size=4))
def test_read_again_it_is_the_same(document):
    assert tomllib.loads(dump(document)) == document


def test_how_it_looks():
    document = {
        "network": "lab",
        "robots": [{"name": "r0"}, {"name": "r1", "host": "pi@r1"}],
        "topology": {"edges": [["r0", "r1"]]},
        "apps": {"consensus": {"value": 0.5, "robots": {"r1": {"value": 5}}}},
        "relay": [],
    }
    assert dump(document) == (
        'network = "lab"\nrelay = []\n\n[[robots]]\nname = "r0"\n\n[[robots]]\nname = "r1"\nhost = "pi@r1"\n\n'
        '[topology]\nedges = [["r0", "r1"]]\n\n[apps.consensus]\nvalue = 0.5\n\n[apps.consensus.robots.r1]\nvalue = 5\n'
    )


def test_what_toml_has_not_is_refused():
    with pytest.raises(LocalError, match="TOML has no NoneType"):
        dump({"x": None})
