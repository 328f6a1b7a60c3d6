"""Arrays in messages: npz without pickle, in both directions."""

from __future__ import annotations

import contextlib
import copy
import io
import tracemalloc
import zipfile
from array import array

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rosrm.node import arrays_message, arrays_of
from rosrm_msgs.msg import Arrays


def test_arrays_come_back_with_their_types_and_shapes():
    """Arrays are equal bit by bit, under any names."""
    arrays = {
        "poses": np.random.default_rng(1).normal(size=(3, 4, 4)),
        "file": np.array([1, 2, 3], dtype=np.int16),
        "name": np.array("lidar"),
        "empty": np.zeros((0, 3), dtype=np.float32),
    }
    back = arrays_of(arrays_message(arrays))
    assert back.keys() == arrays.keys()
    for name, value in arrays.items():
        assert back[name].dtype == value.dtype
        np.testing.assert_array_equal(back[name], value)


def test_python_objects_are_refused():
    """Numpy would pickle them."""
    with pytest.raises(ValueError, match="'map' holds Python objects"):
        arrays_message({"map": np.array([{}, 1], dtype=object)})


def test_what_is_pickled_is_not_read():
    """Unpickling runs code of the sender."""
    packed = io.BytesIO()
    np.savez(packed, evil=np.array([{}], dtype=object))
    with pytest.raises(ValueError, match="no npz of arrays"):
        arrays_of(Arrays(npz=array("B", packed.getvalue())))


def test_what_is_no_npz_is_refused():
    """The error is one sentence, without a traceback of zipfile."""
    with pytest.raises(ValueError, match="these 3 bytes are no npz"):
        arrays_of(Arrays(npz=array("B", b"abc")))


def archive(*entries: tuple[str, bytes], compression: int = zipfile.ZIP_STORED) -> bytes:
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", compression) as file:
        for name, data in entries:
            file.writestr(name, data)
    return packed.getvalue()


def npy(shape: tuple[int, ...], data: bytes = b"", kind: str = "|u1") -> bytes:
    """Return the bytes of one array that claims this shape."""
    file = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        file, {"descr": kind, "fortran_order": False, "shape": shape}
    )
    return file.getvalue() + data


def overlapping(count: int, data: bytes) -> bytes:
    """Return an archive whose directory lists the same bytes under many names."""
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as file:
        file.writestr("_000.npy", data)
        (one,) = file.filelist
        for number in range(1, count):
            another = copy.copy(one)
            another.filename = f"_{number:03}.npy"
            file.filelist.append(another)
        file._didModify = True
    return packed.getvalue()


def deflated(size: int) -> bytes:
    packed = io.BytesIO()
    np.savez_compressed(packed, _big=np.zeros(size, np.uint8))
    return packed.getvalue()


@pytest.mark.parametrize(
    "packed",
    [
        deflated(1 << 28),
        overlapping(600, npy((1 << 20,), bytes(1 << 20))),
        archive(("_a.npy", npy((1 << 60,)))),
        archive(("_a.npy", npy((1 << 63, 8)))),
        archive(("_a.npy", npy((2**40,), kind="|V1000000"))),
        archive(("_a.npy", npy((-1,), b"123"))),
        archive(("_a.npy", b"\x93NUMPY\x09\x09")),
        archive(("_a.npy", b"\x93NUMPY\x01\x00\xff\xff{")),
        archive(("_a.npy", npy((3,), b"123")[:-3])),
        archive(("_a.npy", b"(" * 60_000)),
        b"PK\x05\x06" + bytes(18),
        b"PK\x03\x04" + bytes(100),
        b"\x93NUMPY\x01\x00v\x00" + bytes(200),
    ],
    ids=["deflated", "overlapping", "a shape", "a shape beyond 64 bits", "large elements",
         "a negative shape", "another version", "a header", "short", "nested", "an empty archive",
         "a torn archive", "one array"],
)  # fmt: skip
def test_an_archive_that_claims_more_than_it_holds_costs_no_memory(packed):
    """Foreign bytes raise ValueError, and use no more memory than their own size."""
    tracemalloc.start()
    try:
        with contextlib.suppress(ValueError):
            assert arrays_of(Arrays(npz=array("B", packed))) == {}
        assert tracemalloc.get_traced_memory()[1] < 4 * len(packed) + (1 << 20)
    finally:
        tracemalloc.stop()


@given(st.binary(max_size=300), st.integers(0, 400), st.binary(max_size=8))
def test_any_bytes_are_arrays_or_raise_value_error(garbage, at, change):
    """This holds for bytes at random, and for an npz with some bytes changed."""
    good = arrays_message({"a": np.arange(3), "b": np.zeros(2)}).npz.tobytes()
    for packed in (garbage, good[:at], good[:at] + change + good[at + len(change) :]):
        with contextlib.suppress(ValueError):
            arrays_of(Arrays(npz=array("B", packed)))


def test_field_names_of_any_language_come_back():
    """Numpy stores them in another version of its format."""
    value = np.array([(1, 2.0)], dtype=[("größe", "i4"), ("重さ", "f8")])
    with pytest.warns(UserWarning, match="format 3.0"):
        packed = arrays_message({"a": value})
    np.testing.assert_array_equal(arrays_of(packed)["a"], value)
