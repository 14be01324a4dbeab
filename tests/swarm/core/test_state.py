"""Packing of app states: golden bytes, limits, round trips."""

import enum
import struct
from typing import Annotated, Any

import pytest
from conftest import costly
from hypothesis import given
from hypothesis import strategies as st

from swarm import Matrix, Vector, float32
from swarm.core.snapshot_fields import MOST_LEVELS, pack_private, unpack_private
from swarm.core.state import MAX_STATE, Field, Schema, field_of
from swarm.errors import AppError, FrameError, shown


class Mood(enum.Enum):
    CALM = "calm"
    WILD = "wild"
    LOST = "lost"


ALL = {"a": float, "b": float32, "c": int, "d": bool, "e": Annotated[Vector, 2]}


def schema(**annotations: Any) -> Schema:
    return Schema("App", [field_of(name, annotation) for name, annotation in annotations.items()])


def test_a_packed_state_has_these_bytes() -> None:
    """Little endian, no padding, declared order."""
    packed = schema(**ALL).pack({"a": 1.5, "b": -0.25, "c": -2, "d": True, "e": (3.0, 4.0)})
    assert packed.hex() == (
        "000000000000f83f"  # 1.5 as binary64
        "000080be"  # -0.25 as binary32
        "feffffffffffffff"  # -2 as int64
        "01"
        "0000000000000840"
        "0000000000001040"  # 3.0, 4.0
    )
    assert schema(**ALL).size == 37


def test_a_schema_has_this_hash_on_every_machine() -> None:
    """They are compared between robots, so another Python or another machine must find the same."""
    assert schema(**ALL).hash == 0x3D4B6539
    assert schema(value=float).hash == 0x9D9A2569


def test_the_hash_tells_name_type_order_and_class_apart() -> None:
    hashes = {
        schema(x=float, y=float).hash,
        schema(y=float, x=float).hash,
        schema(x=float, z=float).hash,
        schema(x=float, y=float32).hash,
        schema(x=float, y=Annotated[Vector, 1]).hash,
        schema(x=float).hash,
        Schema("Other", [field_of("x", float), field_of("y", float)]).hash,
    }
    assert len(hashes) == 7


VALUES = st.fixed_dictionaries(
    {
        "a": st.floats(allow_nan=False, allow_infinity=False),
        "b": st.floats(allow_nan=False, allow_infinity=False, width=32),
        "c": st.integers(-(2**63), 2**63 - 1),
        "d": st.booleans(),
        "e": st.tuples(*[st.floats(allow_nan=False, allow_infinity=False)] * 2),
    }
)


@given(VALUES)
def test_what_is_packed_comes_back(values: dict[str, Any]) -> None:
    shared = schema(**ALL)
    packed = shared.pack(values)
    assert len(packed) == shared.size
    back = shared.unpack(packed)
    assert repr(back) == repr(tuple(values[name] for name in shared.names))  # repr: -0.0 stays -0.0
    assert shared.pack(dict(zip(shared.names, back, strict=True))) == packed


@given(st.floats(-3e38, 3e38))
def test_float32_rounds_as_the_wire_does(value: float) -> None:
    assert Field("x", "float32").check(value) == struct.unpack("<f", struct.pack("<f", value))[0]


@pytest.mark.parametrize(
    ("annotation", "value", "message"),
    [
        (float, float("nan"), "nan is not a finite number"),
        (float, float("inf"), "inf is not a finite number"),
        (float, 10**400, "is not a finite number"),
        (float, "3", "expected a number, got '3'"),
        (float, True, "expected a number, got True"),
        (float, None, "expected a number, got None"),
        (float, 1j, "expected a number"),
        (float32, 3.5e38, "beyond the range of float32"),
        (int, 1.0, "expected an integer of 64 bits, got 1.0"),
        (int, True, "expected an integer"),
        (int, 2**63, "expected an integer of 64 bits"),
        (bool, 1, "expected True or False, got 1"),
        (Annotated[Vector, 2], (1.0, 2.0, 3.0), "expected 2 numbers"),
        (Annotated[Vector, 2], 1.0, "expected 2 numbers, got 1.0"),
        (Annotated[Vector, 2], "ab", "expected 2 numbers, got 'ab'"),
        (Annotated[Vector, 2], {1.0, 2.0}, "expected 2 numbers"),
        (Annotated[Vector, 2], (1.0, float("nan")), "not a finite number"),
        (Annotated[Vector, 2], (1.0, "2"), "expected a number"),
    ],
)
def test_wrong_values_are_refused_by_name(annotation: Any, value: object, message: str) -> None:
    with pytest.raises(AppError, match=r"^x: ") as caught:
        schema(x=annotation).pack({"x": value})
    assert message in str(caught.value)


def test_numbers_become_floats_and_lists_tuples() -> None:
    assert schema(x=float).check({"x": 3}) == {"x": 3.0}
    assert schema(x=Annotated[Vector, 2]).check({"x": [1, 2.5]}) == {"x": (1.0, 2.5)}


@pytest.mark.parametrize(
    ("annotation", "message"),
    [
        (list, "not list"),
        (str, "not str"),
        (list[float], "of type float, float32"),
        (Vector, "say how long the vector is"),
        (Annotated[Vector, 0], "positive integer"),
        (Annotated[Vector, "n"], "positive integer"),
        (Annotated[int, 3], "of type float"),
        (float | None, "of type float"),
    ],
)
def test_types_that_cannot_travel_are_refused(annotation: Any, message: str) -> None:
    with pytest.raises(AppError, match=f"x: .*{message}"):
        field_of("x", annotation)


def test_a_state_fits_a_frame_together_with_its_predecessor() -> None:
    schema(x=Annotated[Vector, MAX_STATE // 8]).check_size()
    with pytest.raises(AppError, match=r"takes 448 bytes, a frame holds 440 \(x 440, y 8\)"):
        schema(x=Annotated[Vector, 55], y=float).check_size()
    with pytest.raises(AppError, match="shares no state"):
        schema().check_size()


PRIVATE = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**63), 2**63 - 1)
    | st.floats(allow_nan=False)
    | st.text()
    | st.binary()
    | st.binary().map(bytearray),
    lambda inner: st.lists(inner) | st.lists(inner).map(tuple) | st.dictionaries(st.text() | st.integers(0, 9), inner),
    max_leaves=20,
)


@costly(40)
@given(st.dictionaries(st.text(), PRIVATE, max_size=4))
def test_private_fields_come_back_as_they_were(values: dict[str, Any]) -> None:
    assert repr(unpack_private(pack_private(values))) == repr(values)  # repr: tuples are not lists, 1 is not 1.0


@pytest.mark.parametrize("value", [object(), {1, 2}, 2**64, 1j, lambda: None, [memoryview(b"x")]])
def test_private_fields_that_cannot_be_saved_are_named(value: object) -> None:
    with pytest.raises(AppError, match=r"^_x: .* cannot be saved for a restart"):
        pack_private({"_x": value})


def test_tuples_within_tuples_are_refused_before_a_stack_is_too_small_to_unpack_them() -> None:
    value: object = 0
    for _ in range(MOST_LEVELS):
        value = (value, 1)
    assert unpack_private(pack_private({"_x": value[0]})) == {"_x": value[0]}  # type: ignore[index]
    with pytest.raises(AppError, match=r"_x: .*tuples within tuples, more than 32 levels"):
        pack_private({"_x": value})


def test_an_error_shows_also_what_has_no_text() -> None:
    class Odd:
        def __repr__(self) -> str:
            raise RuntimeError("no text")

    assert shown(10**5000) == "a int"
    assert shown(Odd()) == "a Odd"


def test_a_vector_has_a_column_for_each_entry() -> None:
    assert [c for f in schema(**ALL).fields for c in f.columns] == ["a", "b", "c", "d", "e[0]", "e[1]"]


# Enums and matrices


def test_golden_bytes_of_an_enum_and_a_matrix() -> None:
    both = schema(mood=Mood, table=Annotated[Matrix, 2, 3])
    packed = both.pack({"mood": Mood.LOST, "table": [[1, 2, 3], (4.0, 5.0, 6.0)]})
    assert packed == b"\x02" + struct.pack("<6d", 1, 2, 3, 4, 5, 6)
    assert both.unpack(packed) == (Mood.LOST, ((1.0, 2.0, 3.0), (4.0, 5.0, 6.0)))
    assert both.message_values(dict(zip(both.names, both.unpack(packed), strict=True))) == {
        "mood": "LOST",
        "table": (1.0, 2.0, 3.0, 4.0, 5.0, 6.0),
    }
    assert [field.zero for field in both.fields] == [Mood.CALM, ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))]
    assert both.fields[1].columns == tuple(f"table[{row},{column}]" for row in range(2) for column in range(3))


def test_the_hash_is_over_members_and_shape() -> None:
    other = enum.Enum("Mood", ["CALM", "WILD"])
    kinds = [Mood, other, Annotated[Matrix, 2, 3], Annotated[Matrix, 3, 2], Annotated[Vector, 6]]
    assert len({schema(x=kind).hash for kind in kinds}) == 5


def test_a_member_that_is_not_there_is_a_wrong_frame() -> None:
    with pytest.raises(FrameError, match="mood: there is no member 3"):
        schema(mood=Mood).unpack(b"\x03")


@pytest.mark.parametrize(
    ("annotation", "value", "message"),
    [
        (Mood, "wild", "expected CALM or WILD or LOST, got 'wild'"),
        (Mood, 1, "expected CALM or WILD or LOST, got 1"),
        (Annotated[Matrix, 2, 2], [1.0, 2.0, 3.0], "expected 2 rows of 2 numbers"),
        (Annotated[Matrix, 2, 2], [[1.0, 2.0], [3.0]], "expected 2 rows of 2 numbers"),
        (Annotated[Matrix, 2, 2], [[1.0, 2.0], [3.0, float("inf")]], "inf is not a finite number"),
        (Annotated[Matrix, 2, 2], "1234", "expected 2 rows of 2 numbers"),
        (Annotated[Matrix, 2, 2], 1.0, "expected 2 rows of 2 numbers"),
    ],
)
def test_wrong_enums_and_matrices_are_refused(annotation: Any, value: object, message: str) -> None:
    with pytest.raises(AppError, match=message):
        field_of("x", annotation).check(value)


@pytest.mark.parametrize(
    ("annotation", "message"),
    [
        (Matrix, "say how large the matrix is"),
        (Annotated[Matrix, 2], r"expected Annotated\[Matrix, n, m\] with n and m positive integers, got \(2,\)"),
        (Annotated[Matrix, 2, 0], r"got \(2, 0\)"),
        (enum.Enum("Empty", []), "an enum of 1 to 256 members can be shared, Empty is none"),
    ],
)
def test_enums_and_matrices_that_cannot_be(annotation: Any, message: str) -> None:
    with pytest.raises(AppError, match=message):
        field_of("x", annotation)
