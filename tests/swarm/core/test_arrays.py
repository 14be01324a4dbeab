"""Fields that are numpy arrays: declaration, bytes on the wire, what is refused."""

import struct
import subprocess
import sys
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst

from swarm import Array, Vector, float32
from swarm.core.snapshot_fields import pack_private, unpack_private
from swarm.core.state import Schema, field_of
from swarm.errors import AppError


def schema(**annotations: Any) -> Schema:
    return Schema("App", [field_of(name, annotation) for name, annotation in annotations.items()])


def test_golden_bytes_of_arrays_are_those_of_so_many_doubles_and_floats() -> None:
    declared = schema(x=Array[2], P=Array[2, 2], q=Array[1, float32])
    values = {"x": np.array([3.0, 4.0]), "P": np.array([[1.5, 0.0], [-0.25, 2.0]]), "q": [-0.25]}
    packed = declared.pack(values)
    assert packed.hex() == (
        "00000000000008400000000000001040"  # 3.0, 4.0 as binary64, little endian
        "000000000000f83f0000000000000000"  # row by row
        "000000000000d0bf0000000000000040"
        "000080be"  # -0.25 as binary32
    )
    assert packed == struct.pack("<6df", 3.0, 4.0, 1.5, 0.0, -0.25, 2.0, -0.25)
    assert declared.size == 52
    assert declared.hash == 0xE0198C8


def test_the_hash_tells_shapes_and_widths_apart() -> None:
    declared = (Array[4], Array[2, 2], Array[4, 1], Array[4, float32])
    assert len({schema(x=annotation).hash for annotation in declared}) == 4


FINITE = st.floats(allow_nan=False, allow_infinity=False)
ANY_KIND = npst.floating_dtypes() | npst.integer_dtypes() | npst.boolean_dtypes()


@given(npst.arrays(np.float64, st.tuples(st.integers(1, 4), st.integers(1, 4)), elements=FINITE))
def test_an_array_comes_back_to_the_bit_and_cannot_be_written_to(array: np.ndarray) -> None:
    declared = schema(x=Array[array.shape])
    (back,) = declared.unpack(declared.pack({"x": array}))
    assert back.dtype == np.float64
    assert back.shape == array.shape
    assert back.tobytes() == array.tobytes()
    with pytest.raises(ValueError, match="read-only"):
        back[0] = 1.0


@given(npst.arrays(np.float32, 3, elements=st.floats(allow_nan=False, allow_infinity=False, width=32)))
def test_a_float32_array_comes_back_to_the_bit(array: np.ndarray) -> None:
    assert Array[3, np.float32] == Array[3, float32]
    declared = schema(x=Array[3, float32])
    (back,) = declared.unpack(declared.pack({"x": array}))
    assert back.dtype == np.float32
    assert back.tobytes() == array.tobytes()


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (np.zeros(3), r"x: expected an array of shape \(2,\), got shape \(3,\)"),
        (np.zeros((2, 1)), r"got shape \(2, 1\)"),
        (0.0, r"got shape \(\)"),
        ([1.0, "a"], "expected an array of 2 numbers"),
        (None, "x: expected an array of 2 numbers, got None"),
        ([[1.0], [2.0, 3.0]], "expected an array of 2 numbers"),
        ([1.0, float("nan")], "not all of its numbers are finite"),
        (np.array([1.0, 1j]), "expected an array of 2 numbers"),
    ],
)
def test_what_is_no_array_of_its_shape_is_refused(value: object, message: str) -> None:
    with pytest.raises(AppError, match=message):
        schema(x=Array[2]).pack({"x": value})


@pytest.mark.parametrize("wrong", [0, (), 2.0, True, "a", (1, 1, 1, 1, 1), float32])
def test_a_shape_that_is_none_is_refused(wrong: Any) -> None:
    with pytest.raises(AppError, match=r"^Array\[.*\]: expected positive integers, as in"):
        Array[wrong]


@pytest.mark.parametrize("wrong", [np.ndarray, np.ndarray[Any, Any], Array])
def test_an_array_without_a_shape_is_told_how_to_declare_one(wrong: Any) -> None:
    with pytest.raises(AppError, match=r"x: say the array's shape: `x: Array\[2\]`"):
        field_of("x", wrong)


def test_without_numpy_the_declaration_says_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "numpy", None)
    with pytest.raises(AppError, match=r'x: arrays need numpy.*\[robot\] packages = \["numpy"\]'):
        field_of("x", Array[2])


def test_an_app_without_arrays_does_not_import_numpy() -> None:
    program = (
        "import sys\nfrom typing import Annotated\nfrom swarm import Array, SyncApp, Vector\n"
        "class App(SyncApp):\n    x: Annotated[Vector, 2]\n    def step(self, neighbours): pass\n"
        "import services.apps.runner\nassert 'numpy' not in sys.modules\n"
    )
    subprocess.run([sys.executable, "-c", program], check=True)


@given(npst.arrays(ANY_KIND, npst.array_shapes(min_dims=0)))
def test_private_arrays_and_numbers_of_numpy_come_back_from_a_snapshot(array: np.ndarray) -> None:
    number = array.reshape(-1)[0]
    back = unpack_private(pack_private({"_a": array, "_b": [array], "_c": number}))
    for one, other in ((back["_a"], array), (back["_b"][0], array), (back["_c"], number)):
        assert type(one) is type(other)
        assert one.dtype == other.dtype
        assert one.shape == other.shape
        assert one.tobytes() == other.tobytes()


def test_an_array_of_objects_cannot_be_saved_and_is_named() -> None:
    with pytest.raises(AppError, match=r"_a: .* cannot be saved for a restart"):
        pack_private({"_a": np.array([object()])})


def test_the_message_for_a_vector_stays_as_it_was() -> None:
    with pytest.raises(AppError, match="say how long the vector is"):
        field_of("x", Vector)
