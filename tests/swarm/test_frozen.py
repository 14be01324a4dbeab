"""Frozen dataclasses of our own: what the standard library's give, they give."""

import copy
import dataclasses
import pickle
from collections.abc import Mapping

import pytest

from swarm.frozen import frozen


@frozen
class Place:
    x: float
    y: float = 0.0


@frozen
class Named(Place):
    name: str = "here"
    tags: Mapping[str, int] = dataclasses.field(default_factory=dict)
    secret: str = dataclasses.field(default="", repr=False)
    size: float = dataclasses.field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "size", abs(self.x) + abs(self.y))


@frozen
class Nothing:
    pass


@dataclasses.dataclass(frozen=True, slots=True)
class Standard:
    x: float
    y: float = 0.0


def test_a_frozen_class_is_like_one_of_the_standard_library() -> None:
    ours, theirs = Place(1.0, y=2.0), Standard(1.0, y=2.0)
    assert repr(ours) == repr(theirs).replace("Standard", "Place")
    assert hash(ours) == hash(theirs)
    assert dataclasses.astuple(ours) == dataclasses.astuple(theirs)
    assert [(f.name, f.type, f.default) for f in dataclasses.fields(Place)] == [
        (f.name, f.type, f.default) for f in dataclasses.fields(Standard)
    ]
    assert (Place.__slots__, Place.__match_args__) == (Standard.__slots__, Standard.__match_args__)


def test_values_are_compared_by_type_and_fields() -> None:
    assert Place(1.0) == Place(1.0, 0.0) != Place(1.0, 1.0)
    assert Place(1.0) != Standard(1.0)
    assert Place(1.0) != Named(1.0)
    assert Nothing() == Nothing()
    assert len({Place(1.0), Place(1.0), Place(2.0), Nothing(), Nothing()}) == 3


def test_defaults_are_made_for_each_and_the_class_finishes_itself() -> None:
    first, second = Named(3.0, -4.0), Named(3.0, -4.0)
    assert first.tags == {}
    assert first.tags is not second.tags
    assert first.size == 7.0
    assert repr(Named(1.0, secret="key")) == "Named(x=1.0, y=0.0, name='here', tags={}, size=1.0)"
    assert dataclasses.replace(first, x=1.0).size == 5.0


@pytest.mark.parametrize(
    "change", [lambda p: setattr(p, "x", 1.0), lambda p: setattr(p, "z", 1.0), lambda p: delattr(p, "x")]
)
def test_nothing_can_be_changed(change) -> None:
    place = Place(0.0)
    with pytest.raises(dataclasses.FrozenInstanceError):
        change(place)
    assert place == Place(0.0)


@pytest.mark.parametrize("values", [(), (1.0, 2.0, 3.0)])
def test_wrong_arguments_are_named(values: tuple[float, ...]) -> None:
    with pytest.raises(TypeError, match=r"Place\.__init__\(\)"):
        Place(*values)


def test_a_frozen_object_is_copied_and_pickled() -> None:
    one = Named(1.0, 2.0, tags={"a": 1})
    for other in (copy.copy(one), copy.deepcopy(one), pickle.loads(pickle.dumps(one))):
        assert other == one
        assert other.size == 3.0
